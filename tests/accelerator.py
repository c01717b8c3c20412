"""A GPU that is none: a device of its own for PyTorch, whose tensors are really the CPU's.

As on a GPU, tensors of two devices cannot meet, and what looks at values waits for the device. What is worked out is
exactly what the CPU works out.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.utils import backend_registration
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing

_NAME = "pretended"
_LOOKS = {"_local_scalar_dense", "nonzero", "equal", "allclose", "masked_select", "unique", "_unique2", "unique_dim"}
"""Operators whose result, or its shape, the host has to wait for."""
_COPIES = {"copy_", "_to_copy"}
"""Operators that may be given tensors of two devices; they wait where they copy from one to the other."""
_INDEXES = {"index", "index_put_", "_index_put_impl_", "index_put"}
"""Operators that take the host's indices."""


def _gru_cell(inputs: Tensor, states: Tensor, state: Tensor, *biases: Tensor) -> tuple[Tensor, Tensor]:
    """A step of a GRU and the memory for its gradient, which is left out."""
    (reset_in, update_in, new_in), (reset, update, new) = (
        (gates + bias).chunk(3, -1) for gates, bias in zip((inputs, states), biases, strict=True)
    )
    new = (new_in + (reset_in + reset).sigmoid() * new).tanh()
    return new + (update_in + update).sigmoid() * (state - new), state.new_zeros(0)


_FUSED = {"_thnn_fused_gru_cell": _gru_cell}
"""Operators that the CPU does not have."""


class OnAccelerator(Tensor):
    """A tensor that says to be on the accelerator, and has its values in ``host``."""

    host: Tensor

    @staticmethod
    def __new__(cls, host: Tensor) -> OnAccelerator:
        wrapped = Tensor._make_wrapper_subclass(  # type: ignore[attr-defined]
            cls,
            host.size(),
            strides=host.stride(),
            storage_offset=host.storage_offset(),
            dtype=host.dtype,
            device=torch.device(_NAME, 0),
            requires_grad=host.requires_grad,
        )
        wrapped.host = host
        return wrapped

    def __repr__(self) -> str:  # type: ignore[override]
        return f"OnAccelerator({self.host})"

    def tolist(self) -> Any:
        return self.to("cpu").tolist()

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        raise RuntimeError("the accelerator is switched off")


class Accelerator(TorchDispatchMode):
    """While it is on, there is the device ``pretended:0``.

    Attributes:
        device: its name for PyTorch.
        looks: operators that have made the host wait for it.
    """

    def __init__(self) -> None:
        super().__init__()
        self.device = torch.device(_NAME, 0)
        self.looks: list[str] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        name = func.overloadpacket.__name__
        tensors = [value for value in _flat((*args, *kwargs.values())) if isinstance(value, Tensor)]
        there = [tensor for tensor in tensors if isinstance(tensor, OnAccelerator)]
        here = [tensor for tensor in tensors if not isinstance(tensor, OnAccelerator) and tensor.ndim]
        if there and here and name not in _COPIES | _INDEXES:
            raise RuntimeError(f"{name} was given tensors of two devices")
        given = kwargs.get("device")
        onto = bool(there) if given is None else torch.device(given).type == _NAME
        if name == "copy_":
            onto = isinstance(args[0], OnAccelerator)
        copied_from = [args[1] if name == "copy_" else args[0]] if name in _COPIES else []
        from_host = onto and any(not isinstance(source, OnAccelerator) for source in copied_from)
        if from_host or (there and (name in _LOOKS or not onto or _by_mask(name, args))):
            self.looks.append(name)
        if _from_host(name, onto, args, kwargs):
            self.looks.append(f"{name} from the host")
        if given is not None and onto:
            kwargs["device"] = torch.device("cpu")
        on_host = {key: _mapped(_on_host, value) for key, value in kwargs.items()}
        out = _FUSED.get(name, func)(*_mapped(_on_host, args), **on_host)
        if onto:
            out = _mapped(_on_accelerator, out)
            return return_and_correct_aliasing(func, args, kwargs, out) if _has_aliases(func) else out
        # What is copied into is given back itself.
        return args[0] if name == "copy_" else out


def _flat(values: Iterable[Any]) -> Iterator[Any]:
    """Yields the values within nested lists. PyTorch's own functions for nested values take most of a test's time."""
    for value in values:
        if isinstance(value, list | tuple):
            yield from _flat(value)
        else:
            yield value


def _mapped(change: Callable[[Any], Any], value: Any) -> Any:
    """Changes each value within nested lists."""
    if isinstance(value, list | tuple):
        return type(value)([_mapped(change, part) for part in value])
    return change(value)


@cache
def _has_aliases(func: Any) -> bool:
    """Whether an operator returns a view, or what it was given."""
    return any(returned.alias_info is not None for returned in func._schema.returns)


def _from_host(name: str, onto: bool, args: Any, kwargs: Any) -> bool:
    """Whether values of the host are copied to the device, which waits for its earlier work."""
    if name in _COPIES:
        source = args[1] if name == "copy_" else args[0]
        return (
            onto and not isinstance(source, OnAccelerator) and not (kwargs.get("non_blocking") or args[2:3] == (True,))
        )
    indices = args[1] if name in _INDEXES else ()
    return onto and any(index is not None and not isinstance(index, OnAccelerator) for index in indices)


def _by_mask(name: str, args: Any) -> bool:
    """Whether an index is a mask: its true entries have to be counted."""
    return name in _INDEXES and any(index is not None and index.dtype == torch.bool for index in args[1])


def _on_host(value: Any) -> Any:
    return value.host if isinstance(value, OnAccelerator) else value


def _on_accelerator(value: Any) -> Any:
    return OnAccelerator(value) if isinstance(value, Tensor) and not isinstance(value, OnAccelerator) else value


class _Event:
    """An event of the device, which keeps up with the host."""

    def __init__(self, enable_timing: bool = False) -> None: ...

    def record(self) -> None:
        self._time = time.perf_counter()

    def elapsed_time(self, end: _Event) -> float:
        return 1000 * (end._time - self._time)


class _Module(backend_registration._DummyBackendModule):  # type: ignore[misc]
    """What stands for ``torch.cuda``."""

    Event = _Event

    def synchronize(self, device: Any = None) -> None: ...


@contextmanager
def accelerator() -> Iterator[Accelerator]:
    """Switches the device on, once in a process and before its first gradient: take a process of its own for it."""
    backend_registration._setup_privateuseone_for_python_backend(_NAME, _Module())
    # Else ``torch.tensor(..., device=...)`` would make its storage before the mode is asked.
    torch._C._set_only_lift_cpu_tensors(True)
    with Accelerator() as mode:
        yield mode
    torch._C._set_only_lift_cpu_tensors(False)
