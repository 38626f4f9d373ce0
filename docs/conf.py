"""Settings of the docs site: `make docs` builds it into docs/_build/html, without a network."""

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE / "_ext"), str(HERE.parent / "src"), str(HERE.parent / "bench")]

import mover

project = "mover"
version = release = mover.__version__
copyright = "the authors of mover, Apache-2.0"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "equations"]
myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence"]
myst_heading_anchors = 4
exclude_patterns = ["_build", "_ext", "tables"]
html_theme = "furo"
html_title = "mover"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_math_renderer = "mathml"
html_copy_source = False
html_show_sphinx = False
default_role = "code"
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True, "undoc-members": True}
napoleon_google_docstring = True
add_module_names = False
python_maximum_signature_line_length = 80
python_use_unqualified_type_names = True
BLUE = {"color-brand-primary": "#2f5d9b", "color-brand-content": "#2f5d9b"}
html_theme_options = {"footer_icons": [], "light_css_variables": BLUE}


OTHERS = "% others: conf.py puts pages here that are not named above"


def plain(_app, what, name, _obj, _options, lines):
    """Docstrings are plain text: no substitutions; tables of modules are shown as they stand."""
    if what == "module" and any(line.strip() for line in lines[1:]):
        lines[:] = [lines[0], "", "::", "", *("   " + line for line in lines[1:]), ""]
    else:
        lines[:] = [line.replace("|", r"\|") for line in lines]
    if what == "attribute":
        _fields[name] = list(lines)


def whole(_app, what, name, _obj, _options, lines):
    """Undo napoleon's reading of a field's docstring as `type: text`."""
    if what == "attribute" and name in _fields:
        lines[:] = _fields[name]


_fields = {}


def bare(_app, what, _name, obj, _options, _signature, _returns):
    """The head of a class without its fields, which follow with their meaning."""
    ours = what == "class" and obj.__module__.startswith("mover")
    return ("", None) if ours else None


def complete(_app, docname, source):
    """Name pages that the index does not name."""
    if docname == "index":
        pages = {path.stem for path in HERE.glob("*.md")} - {"index"} - set(source[0].splitlines())
        source[0] = source[0].replace(OTHERS, "\n".join(sorted(pages)))


def setup(app):
    """Called by Sphinx."""
    app.connect("autodoc-process-docstring", plain, priority=400)
    app.connect("autodoc-process-docstring", whole, priority=600)
    app.connect("autodoc-process-signature", bare)
    app.connect("source-read", complete)
