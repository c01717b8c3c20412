"""PyTorch's defaults, for functions that must not depend on those of the program that calls them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from functools import wraps
from typing import ParamSpec, TypeVar

import torch

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")
_CPU = torch.device("cpu")


def with_torch_defaults(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Decorates a function so that it makes ordinary tensors, float32 on the CPU unless it says otherwise.

    It then does the same after ``torch.set_default_dtype`` and ``torch.set_default_device``, and within
    ``torch.inference_mode()``, whose tensors could not be changed outside of it.
    """

    @wraps(function)
    def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        made = torch.empty(0)
        if made.dtype is torch.float32 and made.device == _CPU and not made.is_inference():
            return function(*args, **kwargs)
        with ExitStack() as stack:
            stack.callback(torch.set_default_dtype, made.dtype)
            torch.set_default_dtype(torch.float32)
            if made.device != _CPU:
                stack.enter_context(_CPU)
            if made.is_inference():
                stack.enter_context(torch.inference_mode(False))
                stack.enter_context(torch.no_grad())
            return function(*args, **kwargs)

    return call
