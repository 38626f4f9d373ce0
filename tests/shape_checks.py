"""The checker of shapes and types that pytest puts around every function of the packages."""

from beartype import BeartypeConf, beartype

checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
