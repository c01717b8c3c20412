"""Driving by hand: keys and a pad on the page.

A key or button that is held sends a message 20 times a second. Without messages, the rover stops: a page that is
closed, hidden or disconnected drives nothing.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path

import viser
from torch import Tensor

HOLD_RATE = 20.0  # messages of a held button, 1/s
TIMEOUT = 0.2  # time after the last message of a button from which on it counts as released, s
DIRECTIONS = {"▲": (1.0, 0.0), "◀": (0.0, 1.0), "▼": (-1.0, 0.0), "▶": (0.0, -1.0)}
"""Buttons, and the shares of the top speed forward and of the largest turn to the left that they command."""
TURN = math.radians(60)  # offset of the heading that a turn commands, rad

_KEYS = Path(__file__).with_name("pilot.js")


class Pilot:
    """Commands of a person on the page, who may take over from the policy (``active``). Adds the pad to a page."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._pressed = dict.fromkeys(DIRECTIONS, -math.inf)
        self.active = False
        gui.add_markdown("**By hand**: hold W A S D, the arrows or these buttons. Let go, and the rover stops.")
        for label, hint in zip(DIRECTIONS, ("W or ↑", "A or ←", "S or ↓", "D or →"), strict=True):
            button = gui.add_button(label, hint=f"Drive by hand while held: {hint}")
            button.on_hold(self._presser(label), callback_hz=HOLD_RATE)
        self._wheel = gui.add_button("Take over", color="orange")
        self._wheel.on_click(lambda _: self.give_back() if self.active else self.take_over())
        script = _KEYS.read_text().partition("\n")[2].replace('"', "&quot;")
        gui.add_html(f'<img src="data:," style="display:none" onerror="{script}">')

    def _presser(self, label: str) -> Callable:
        # A coroutine runs in the loop of the server, which no other callback can hold up.
        async def press(_: object) -> None:
            self._pressed[label] = time.monotonic()
            if not self.active:
                self.take_over()

        return press

    def take_over(self) -> None:
        """Lets the person drive. The rover stands as long as nothing is pressed."""
        self.active, self._wheel.label = True, "Give back to the policy"

    def give_back(self) -> None:
        """Lets the policy drive."""
        self.active, self._wheel.label = False, "Take over"

    def command(self) -> tuple[float, float]:
        """Returns the shares of the top speed forward and of the largest turn to the left, -1 to 1 each."""
        now = time.monotonic()
        held = [DIRECTIONS[label] for label, pressed in self._pressed.items() if now - pressed < TIMEOUT]
        speed, turn = (sum(part) for part in zip((0.0, 0.0), *held, strict=True))
        return max(-1.0, min(1.0, speed)), max(-1.0, min(1.0, turn))

    def steered(self, action: Tensor, row: int, max_speed: float) -> Tensor:
        """Returns the actions ``[N, k]``, of which that of ``row`` is the person's if one has taken over."""
        if not self.active:
            return action
        speed, turn = self.command()
        steered = action.clone()
        steered[row] = 0.0
        steered[row, 0], steered[row, 1] = speed * max_speed, turn * TURN
        return steered
