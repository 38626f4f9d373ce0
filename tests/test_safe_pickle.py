import builtins
import bz2
import collections
import contextlib
import gzip
import io
import lzma
import os
import pickle
import pickletools
import posix
import struct
import subprocess
import zlib
from functools import partial, reduce
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse

from mover.bodies.smpl_files import load_smpl, read_matrix
from mover.core import pickles
from mover.core.errors import InputError
from mover.core.pickles import load_plain

PLAIN = {
    "row": np.arange(6.0).reshape(2, 3),
    "columns": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    "big end": np.arange(3, dtype=">i4"),
    "none": np.zeros((0, 3), np.float32),
    "point": np.array(2.5),
    "words": np.array(["aé", "b"]),
    "bits": np.array([True, False]),
}


@pytest.fixture
def file(tmp_path):
    def write(data: bytes) -> Path:
        path = tmp_path / "x.pkl"
        path.write_bytes(data)
        return path

    return write


def refused(path: Path, words: str) -> None:
    with pytest.raises(InputError, match=words):
        load_plain(path)


class Calls:
    """Reduces to any call."""

    def __init__(self, what, *args):
        self.what, self.args = what, args

    def __reduce__(self):
        return self.what, self.args


class Sneaky(dict):
    def __reduce__(self):
        return getattr, (os, "system")


@pytest.mark.parametrize("protocol", range(6))
def test_hostile_pickles_are_refused_by_name_and_run_nothing(file, tmp_path, protocol):
    done = tmp_path / "done"
    text = f"open({str(done)!r}, 'w')"
    attacks = [
        (Calls(os.system, f"touch {done}"), "system"),
        (Calls(posix.system, f"touch {done}"), "system"),
        (Calls(eval, text), "eval"),
        (Calls(exec, text), "exec"),
        (Calls(getattr, os, "system"), "getattr"),
        (Calls(Calls(getattr, os, "system"), f"touch {done}"), "getattr"),
        (Calls(subprocess.Popen, ["touch", str(done)]), "Popen"),
        (Calls(builtins.__import__, "os"), "__import__"),
        (Calls(open, str(done), "w"), "open"),
        (Calls(np.load, "x.npy", None, True), "load"),
        (Calls(torch.load, "x"), "load"),
        (Calls(pickle.loads, b"x"), "loads"),
        (Sneaky(), "getattr"),
    ]
    for attack, name in attacks:
        try:
            data = pickle.dumps({"a": [attack]}, protocol=protocol)
        except (pickle.PicklingError, TypeError):
            continue  # a module as an argument cannot be written
        refused(file(data), rf"^x\.pkl: the pickle holds .*{name}")
    assert not done.exists()


@pytest.mark.parametrize("code", [
    b"cos\nsystem\n(S'true'\ntR.",
    b"cposix\nsystem\n(S'true'\ntR.",
    b"(S'true'\nios\nsystem\n.",
    b"\x80\x02(cos\nsystem\nX\x04\x00\x00\x00trueo.",
    b"\x80\x02\x82\x01.",
    b"c__builtin__\ngetattr\n(cos\nsystem\nS'x'\ntR.",
    b"\x80\x04\x8c\x08builtins\x8c\x04eval\x93\x8c\x011\x85R.",
    b"\x80\x04\x8c\x05numpy\x8c\x0ecore.os.system\x93\x8c\x011\x85R.",
    b"cnumpy.core.multiarray\n_reconstruct\n(cos\nsystem\nK\x00\x85U\x01btR.",
    b"ccopy_reg\n_reconstructor\n(cos\nsystem\nc__builtin__\nobject\nNtR.",
    b"\x80\x02c__builtin__\nset\n}U\x08__call__cos\nsystem\nsb.",
    b"\x80\x02cchumpy.ch\n__class__.__mro__\n)R.",
    b"\x80\x02Ptrue\n.",
    b"\x80\x02K\x01Q.",
    b"\x80\x02cnumpy\nndarray\n(J\xff\xff\xff\x7ftR.",
    b"\x80\x02c__builtin__\nbytearray\n(J\xff\xff\xff\x7ftR.",
    b"\x80\x02c__builtin__\nlist\n(X\x01\x00\x00\x00atR.",
    b"\x80\x05\x96\xff\xff\xff\xff\xff\xff\x00\x00.",
    b"\x80\x04\x8e\xff\xff\xff\xff\xff\xff\x00\x00.",
    b"\x80\x02K\x01r\xff\xff\xff\x7f",
    b"\x80\x02]q\x00h\x00b.",
    b"\x80\x02h\x05.",
    b"\x80\x02a.",
    b"\x80\x02(t",
    b"(" * 50 + b"t" * 51 + b".",
    b"",
    b"no pickle",
    b"PK\x03\x04 no zip",
    b"\x93NUMPY no header",
    b"\x1f\x8b no gzip",
    b"\x78\x9c no zlib",
])  # fmt: skip
def test_code_written_by_hand_ends_in_an_input_error(file, code):
    refused(file(code), r"^x\.pkl: ")


def test_no_opcode_can_call_import_or_set_an_attribute_of_a_thing():
    """Every class and function is a word, whose calls are data; what makes them is written here."""
    assert len(pickles.MADE) > 20
    assert all(maker.__module__ == "mover.core.pickles" for maker in pickles.MADE.values())
    for name in {*pickles.WORDS, *pickles.MADE} - {"copyreg._reconstructor", "copyreg.__newobj__"}:
        word = pickles.Reader(io.BytesIO()).find_class(*name.rsplit(".", 1))
        assert type(word) is pickles.Word
        assert type(word("x")) is pickles.Call
    new, word = pickles.Word("copyreg._reconstructor"), pickles.Word("builtins.object")
    for make, more in ((new, (word, None)), (pickles.Word("copyreg.__newobj__"), ("x",))):
        with pytest.raises(ValueError, match="no name"):
            make(os.system, *more)
    codes = {opcode.name: ord(opcode.code) for opcode in pickletools.opcodes}
    never = "INST OBJ EXT1 EXT2 EXT4 PERSID BINPERSID NEXT_BUFFER NEWOBJ_EX"
    assert {codes[name] for name in never.split()}.isdisjoint(pickles.Reader.dispatch)
    assert set(pickles.Reader.dispatch) <= set(codes.values())
    names = ("BUILD", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3")  # tuples: keys with a quick hash
    own = {codes[name] for name in names}
    assert all(pickles.Reader.dispatch[code].__module__ == "mover.core.pickles" for code in own)
    assert pickles.Reader.find_class is not pickle._Unpickler.find_class


@pytest.mark.parametrize("protocol", range(1, 6))
def test_arrays_come_back_as_numpy_would_read_them(file, protocol):
    found = load_plain(file(pickle.dumps(PLAIN, protocol=protocol)))
    for key, array in PLAIN.items():
        assert (found[key].dtype, found[key].shape) == (array.dtype, array.shape)
        np.testing.assert_array_equal(found[key], array)
        assert found[key].flags.writeable


plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text()
    | st.binary(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text() | st.integers(), inner)
    | st.tuples(inner, inner) | st.frozensets(st.integers()),
)  # fmt: skip


def tree(value):
    """The same with keys as text, and lists in place of tuples."""
    if isinstance(value, dict):
        return {str(key): tree(item) for key, item in value.items()}
    return [tree(v) for v in value] if isinstance(value, list | tuple) else value


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(plain, st.integers(2, 5))
def test_plain_values_come_back_equal(tmp_path_factory, value, protocol):
    path = tmp_path_factory.mktemp("p") / "x.pkl"
    path.write_bytes(pickle.dumps(value, protocol=protocol))
    assert load_plain(path) == tree(value)


@settings(max_examples=80, deadline=None)
@given(st.integers(0, 10_000), st.integers(0, 255))
def test_a_broken_byte_gives_a_value_or_an_input_error(tmp_path_factory, at, byte):
    data = bytearray(pickle.dumps({**PLAIN, "s": sparse.csc_matrix(np.eye(2))}, protocol=2))
    data[at % len(data)] = byte
    path = tmp_path_factory.mktemp("p") / "x.pkl"
    path.write_bytes(bytes(data))
    with contextlib.suppress(InputError):  # and nothing else
        load_plain(path)


def test_containers_paths_and_numbers_of_other_classes_become_plain(file):
    value = {
        "o": collections.OrderedDict(a=1), "d": collections.defaultdict(list, {"q": [1]}),
        "p": Path("/a/b"), "c": 1 + 2j, "f": np.float32(3), "i": np.int64(4), "s": {1, 2},
        "x": np.array([1, "x", None, [2], np.ones(2)], dtype=object), "t": np.float32,
    }  # fmt: skip
    found = load_plain(file(pickle.dumps(value, protocol=4)))
    assert found.pop("x")[:4] == [1, "x", None, [2]]
    assert found == {"o": {"a": 1}, "d": {"q": [1]}, "p": "/a/b", "c": 1 + 2j, "f": 3, "i": 4,
                     "s": {1, 2}, "t": "numpy.float32"}  # fmt: skip


def shared(kind: type) -> Any:
    """40 lists, each twice in the next: 130 bytes that unfold to 2 ** 40 items."""
    return reduce(lambda nested, _: kind((nested, nested)), range(40), kind((1.0,)))


def itself() -> list:
    loop: list = [1.0]
    loop += [loop, loop]
    return loop


BOMBS = {
    "shared lists": partial(shared, list), "shared tuples": partial(shared, tuple),
    "a list that contains itself": itself,
}  # fmt: skip
READERS = (load_plain, lambda path: load_smpl("smpl", place=path), read_matrix)


@pytest.mark.parametrize("bomb", BOMBS)
def test_a_bomb_is_refused_at_once_by_every_reader(file, bomb):
    path = file(pickle.dumps({"v_template": BOMBS[bomb](), "mtx": BOMBS[bomb]()}))
    wanted = "unfolds to more than" if bomb.startswith("shared") else "contains itself"
    for read in READERS:
        with pytest.raises(InputError, match=rf"^x\.pkl: .*{wanted}"):
            read(path)


def test_shared_arrays_count_as_often_as_they_stand_there_and_plain_ones_are_read(file):
    array, nested = np.zeros(1 << 20), [[1, [2.5, "a"]], ({"k": None}, np.float32(3))]
    refused(file(pickle.dumps([array] * 300)), "unfolds to more than")
    found = load_plain(file(pickle.dumps({7: nested, "o": np.array([[1, None]], object)})))
    assert found == {"7": [[1, [2.5, "a"]], [{"k": None}, 3]], "o": [[1, None]]}


@pytest.mark.parametrize("kind", [list, tuple])
def test_lists_that_are_too_deep_are_refused(file, kind):
    lists = b"".join((b"](" * 5000, b"e" * 5000)) if kind is list else b")" + b"\x85" * 5000
    refused(file(b"\x80\x02" + lists + b"."), r"^x\.pkl: .*64 levels")


def test_keys_that_are_deep_or_double_each_time_are_refused_before_they_are_hashed(file):
    deep_key = b")" + b"\x85" * 20_000
    doubled = b")" + b"2\x86" * 60
    for key in (deep_key, doubled):
        for form in (b"}%sK\x01s", b"(%sK\x01d", b"}(%sK\x01u", b"\x8f(%s\x90", b"(%s\x91",
                     b"cbuiltins\nfrozenset\n(]%satR", b"cbuiltins\nset\n(]%satR"):  # fmt: skip
            refused(file(b"\x80\x04" + form % key + b"."), "key that is no text")


@pytest.mark.parametrize("form", ["csc", "csr", "coo"])
def test_sparse_matrices_come_back_and_odd_indices_are_refused(file, form):
    dense = np.array([[0, 1.5, 0], [2, 0, 0]])
    found = load_plain(file(pickle.dumps(getattr(sparse, f"{form}_matrix")(dense), protocol=2)))
    np.testing.assert_array_equal(found.toarray(), dense)
    bad = getattr(sparse, f"{form}_matrix")(dense)
    for name in ("indices", "row"):
        if hasattr(bad, name):
            getattr(bad, name)[0] = 10**6
    refused(file(pickle.dumps(bad, protocol=2)), "cannot be read")


def old_pickle_of_python_2(arrays: dict[str, np.ndarray]) -> bytes:
    """The bytes that Python 2 and chumpy 0.70 wrote: text for bytes, old module names."""
    out = io.BytesIO()
    w = out.write

    def text(value: bytes) -> bytes:
        return b"T" + struct.pack("<i", len(value)) + value

    w(b"\x80\x02}(")
    for key, array in arrays.items():
        w(text(key.encode()))
        w(b"ccopy_reg\n_reconstructor\n(cchumpy.ch\nCh\nc__builtin__\nobject\nNtR}(")
        w(text(b"_dirty_vars") + b"c__builtin__\nset\n(](" + text(b"x") + b"etR" + text(b"x"))
        w(b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\nK\x00\x85U\x01btR(K\x01(")
        for n in array.shape:
            w(b"J" + struct.pack("<i", n))
        none = b"J\xff\xff\xff\xff"
        w(b"tcnumpy\ndtype\n(U\x02f8K\x00K\x01tR(K\x03U\x01<NNN" + 2 * none + b"K\x00tb")
        w(b"\x89" + text(array.astype("<f8").tobytes()) + b"tbub")
    w(b"u.")
    return out.getvalue()


def test_chumpy_arrays_of_python_2_are_read_without_chumpy(file):
    rng = np.random.default_rng(0)
    arrays = {"v_template": rng.normal(size=(5, 3)), "weights": rng.normal(size=(5, 2))}
    found = load_plain(file(old_pickle_of_python_2(arrays)))
    for key, array in arrays.items():
        assert type(found[key]) is np.ndarray
        np.testing.assert_array_equal(found[key], array)


def test_a_selection_of_a_chumpy_array_is_its_values_and_a_sum_is_refused(file):
    base = np.arange(12.0).reshape(3, 4)
    start = b"\x80\x02ccopy_reg\n_reconstructor\n(cchumpy.reordering\nSelect\n"
    start += b"c__builtin__\nobject\nNtR"
    state = {"a": base, "idxs": np.array([0, 5, 11, 2]), "preferred_shape": (2, 2)}
    inner = pickle.dumps(state, protocol=2)[2:-1]
    found = load_plain(file(start + inner + b"b."))
    np.testing.assert_array_equal(found, [[0, 5], [11, 2]])
    inner = pickle.dumps({"b": base}, protocol=2)[2:-1]
    refused(file(start + inner + b"b."), r"chumpy\.reordering\.Select without an array")


TENSORS = {
    "part": torch.arange(12.0).reshape(3, 4)[:, 1:].T,
    "whole": torch.arange(5),
    "bits": torch.tensor([True, False]),
    "brain": torch.tensor([1.5, -2.0], dtype=torch.bfloat16),
    "same": torch.ones(2).expand(3, 2),
    "learned": torch.nn.Parameter(torch.full((2,), 0.5)),
    "empty": torch.zeros(0, 3),
}


def test_torch_tensors_become_arrays_from_pickles_and_both_forms_of_torch_files(file, tmp_path):
    found = [load_plain(file(pickle.dumps(TENSORS)))]
    for new in (True, False):
        torch.save(TENSORS, tmp_path / "x.pt", _use_new_zipfile_serialization=new)
        found.append(load_plain(tmp_path / "x.pt"))
    for key, tensor in TENSORS.items():
        half = tensor.dtype == torch.bfloat16
        expected = (tensor.float() if half else tensor).detach().numpy()
        for arrays in found:
            np.testing.assert_array_equal(arrays[key], expected)


@pytest.mark.parametrize("new", [True, False])
def test_hostile_torch_files_are_refused_and_their_text_names_no_way_around(tmp_path, new):
    for value, words in (
        (Calls(os.system, "true"), r"^x\.pt: .*system, expected (tensors|arrays), numbers"),
        (torch.ones(1).expand(1 << 29), "larger than what it holds"),
        ([np.ones(2), torch.ones(2)], r"numpy's arrays beside tensors, .*store both as one"),
    ):
        torch.save({"a": value}, tmp_path / "x.pt", _use_new_zipfile_serialization=new)
        with pytest.raises(InputError, match=words) as error:
            load_plain(tmp_path / "x.pt")
        assert "weights_only" not in str(error.value)


MORE = {  # values, what their bytes say instead, and how that is refused
    "beyond its storage": (torch.arange(4.0), b"K\x04\x85", b"\x85", "larger than what it holds"),
    "repeated too often": (torch.ones(1).expand(1 << 29), b"", b"", "larger than what it holds"),
    "more than its bytes": (np.zeros((2, 3), np.float32), b"K\x02K\x03\x86", b"K\x03\x86",
                            "do not fit its shape"),
}  # fmt: skip


@pytest.mark.parametrize("case", MORE)
def test_tensors_and_arrays_that_claim_more_than_they_hold_are_refused(file, case):
    value, old, new, words = MORE[case]
    data = pickle.dumps(value, protocol=2)
    huge = data.replace(old, b"J\xff\xff\xff\x7f" + new) if old else data
    assert (huge != data) == bool(old)
    refused(file(huge), words)
    few = pickle.dumps(torch.ones(1).expand(1000), protocol=2)
    assert load_plain(file(few)).shape == (1000,)


def test_objects_inside_an_npy_file_are_read_and_plain_ones_are_no_pickle(tmp_path):
    np.save(tmp_path / "x.npy", np.array({"pred_cam_R": np.eye(3)}, dtype=object))
    found = load_plain(tmp_path / "x.npy")
    np.testing.assert_array_equal(found["pred_cam_R"], np.eye(3))
    np.save(tmp_path / "x.npy", np.eye(3))
    refused(tmp_path / "x.npy", "which is no pickle")


@pytest.mark.parametrize("pack", [zlib.compress, gzip.compress, bz2.compress, lzma.compress])
def test_packed_pickles_are_unpacked_but_bombs_are_not(file, pack, monkeypatch):
    data = pack(pickle.dumps(PLAIN["row"]))
    np.testing.assert_array_equal(load_plain(file(data)), PLAIN["row"])
    refused(file(data[:-3]), "ends too early")
    monkeypatch.setattr(pickles, "LARGEST", 100_000)
    bomb = pack(bytes(10_000_000))
    refused(file(bomb), "unpacks to more than 100000 bytes")


def test_a_file_that_is_too_large_or_missing_is_refused(file, tmp_path, monkeypatch):
    assert pickles.LARGEST > 1 << 30
    monkeypatch.setattr(pickles, "LARGEST", 100)
    refused(file(pickle.dumps(np.zeros(100))), "expected at most 100")
    refused(tmp_path / "none.pkl", "no such file")


def test_an_array_of_joblib_that_is_cut_off_is_refused(tmp_path):
    path = tmp_path / "x.pkl"
    joblib.dump({"verts": np.arange(12.0).reshape(4, 3)}, path)
    path.write_bytes(path.read_bytes()[:-40])
    refused(path, "do not fit")


@pytest.mark.parametrize("compress", [0, 3, ("lzma", 3)])
def test_files_of_joblib_are_read(tmp_path, compress):
    value = {0: {**PLAIN, "list": [np.ones(3), "x"], "object": np.array([1, None], dtype=object)}}
    joblib.dump(value, tmp_path / "x.pkl", compress=compress)
    found = load_plain(tmp_path / "x.pkl")["0"]
    for key, array in PLAIN.items():
        np.testing.assert_array_equal(found[key], array)
    assert found["object"] == [1, None]
    np.testing.assert_array_equal(found["list"][0], np.ones(3))
