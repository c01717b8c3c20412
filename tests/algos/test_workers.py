"""How worker processes start."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

from rover_rl.algos.workers import interrupts_held

STARTED = "import signal; print(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, []))"


@pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="Windows has no masks of signals")
def test_an_interrupt_waits_until_processes_have_started_and_does_not_reach_them() -> None:
    outputs = []
    signal.signal(signal.SIGINT, signal.default_int_handler)  # whatever ran before in this process

    def start() -> None:
        with interrupts_held():
            signal.raise_signal(signal.SIGINT)
            outputs.append(subprocess.run([sys.executable, "-c", STARTED], capture_output=True, text=True).stdout)

    with pytest.raises(KeyboardInterrupt):
        start()
    assert outputs == ["True\n"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])
