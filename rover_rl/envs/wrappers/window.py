"""Window for ``render_mode="human"``."""

from __future__ import annotations

import os

import numpy as np
from numpy.typing import NDArray


class Window:
    """Shows images in a pygame window, of which a process has one.

    :meth:`show` waits so that there are at most ``fps`` images per second. The window is not opened again after the
    user has closed it, which ``dismissed`` tells.

    Raises:
        ImportError: if pygame is not installed.
        RuntimeError: if there is no display.
    """

    def __init__(self, title: str, fps: float) -> None:
        # Prevents pygame from printing a greeting to standard output.
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        try:
            import pygame
        except ImportError as error:
            raise ImportError('render_mode="human" needs pygame: pip install "rover_rl[human]"') from error
        self._pygame = pygame
        self._title, self._fps = title, fps
        self._clock = pygame.time.Clock()
        self.dismissed = False
        try:
            pygame.display.init()
        except pygame.error as error:
            raise RuntimeError(f'render_mode="human" needs a display: {error}; "rgb_array" needs none') from error

    def show(self, picture: NDArray[np.uint8]) -> None:
        """Shows an image, uint8 ``[height, width, 3]``."""
        display = self._pygame.display
        size = picture.shape[1], picture.shape[0]
        screen = display.get_surface() if display.get_init() else None
        if screen is None or screen.get_size() != size:
            display.init()
            screen = display.set_mode(size)
            display.set_caption(self._title)
        if self._pygame.event.get(self._pygame.QUIT):
            self.dismissed = True
            self.close()
            return
        self._pygame.event.pump()
        screen.blit(self._pygame.image.frombytes(picture.tobytes(), size, "RGB"), (0, 0))
        display.flip()
        self._clock.tick(self._fps)

    def close(self) -> None:
        """Closes the window. Idempotent."""
        self._pygame.display.quit()
