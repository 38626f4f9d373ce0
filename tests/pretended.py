"""A device that is none: torch holds that its tensors lie elsewhere, and the CPU does the work.

What would fail on a GPU fails here: tensors of two devices in one operation.
Torch must know the device before the first gradient of a process, so what needs it runs in a
process with `OWN` in its environment (`test_device.py`).
"""

import os
from collections.abc import Generator
from contextlib import contextmanager
from functools import cache

import pytest
import torch
from torch.utils._python_dispatch import return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

aten = torch.ops.aten
NAME = "elsewhere"
OWN = "MOVER_TESTS_PRETEND"


class Elsewhere(torch.Tensor):
    """A tensor that says that it lies on the device; `here` is where it really is."""

    here: torch.Tensor

    @staticmethod
    def __new__(cls, here):
        x = torch.Tensor._make_wrapper_subclass(
            cls, here.shape, strides=here.stride(), storage_offset=here.storage_offset(),
            dtype=here.dtype, device=f"{NAME}:0",
        )  # fmt: skip
        x.here = here
        return x

    def __repr__(self):
        return f"Elsewhere({self.here})"

    def tolist(self):
        """The numbers."""
        return self.here.tolist()

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        _check(func, args, kwargs)
        out = func(*tree_map(_here, args), **tree_map(_here, kwargs))
        asked = kwargs.get("device")
        if asked is not None and torch.device(asked).type == "cpu":
            return out
        out = tree_map(lambda x: Elsewhere(x) if isinstance(x, torch.Tensor) else x, out)
        return return_and_correct_aliasing(func, args, kwargs, out)


def _here(x):
    if isinstance(x, torch.device):
        return torch.device("cpu")
    return x.here if isinstance(x, Elsewhere) else x


def _check(func, args, kwargs):
    """Refuse what a GPU would refuse."""
    tensors = [x for x in tree_leaves((args, kwargs)) if isinstance(x, torch.Tensor)]
    local = [x for x in tensors if not isinstance(x, Elsewhere)]
    copies = func.overloadpacket in (aten.copy_, aten.index, aten.index_put_, aten._index_put_impl_)
    if not copies and any(x.dim() for x in local):
        raise RuntimeError(f"{func}: tensors here and elsewhere, {[tuple(x.shape) for x in local]}")


def _empty(size, dtype=None, **_rest):
    return Elsewhere(torch.empty(size, dtype=dtype))


def _empty_strided(size, stride, dtype=None, **_rest):
    return Elsewhere(torch.empty_strided(size, stride, dtype=dtype))


def _copy_from(source, to, *_):
    _here(to).copy_(_here(source))
    return to


@cache
def registered() -> torch.library.Library:
    """Make the device known to torch; skips where a GPU is, whose work torch would then neglect."""
    if OWN not in os.environ:
        pytest.skip("in a process of its own: run by test_device.py")
    if torch.cuda.is_available():
        pytest.skip("a GPU is here: nothing is pretended")
    _setup_privateuseone_for_python_backend(NAME)
    library = torch.library.Library("aten", "IMPL")
    library.impl("empty.memory_format", _empty, "PrivateUse1")
    library.impl("empty_strided", _empty_strided, "PrivateUse1")
    library.impl("_copy_from", _copy_from, "PrivateUse1")
    return library


@contextmanager
def kernels_elsewhere() -> Generator[torch.device, None, None]:
    """Warp reads what lies on the device, and is launched as for a GPU; gives the device."""
    import warp as wp

    registered()
    from_torch, of = wp.from_torch, wp.device_from_torch
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(wp, "from_torch", lambda x, **rest: from_torch(_here(x), **rest))
        patch.setattr(wp, "device_from_torch", lambda d: of(_here(torch.device(d))))
        yield torch.device(NAME)
