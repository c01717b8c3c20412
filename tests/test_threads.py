"""Kernels keep their CPU threads where PyTorch has one."""

from __future__ import annotations

import torch

from rover_rl.native.threads import kernel_threads, single_threaded


def test_kernels_keep_the_threads_that_pytorch_gives_up():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        with single_threaded(), single_threaded():
            assert (torch.get_num_threads(), kernel_threads()) == (1, 3)
        assert (torch.get_num_threads(), kernel_threads()) == (3, 3)
    finally:
        torch.set_num_threads(before)
