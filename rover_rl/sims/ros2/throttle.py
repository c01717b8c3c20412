"""Throttled logging of warnings."""

from __future__ import annotations

import logging
import math
import time

WARNING_INTERVAL = 5.0
"""Minimum time between two warnings with the same key, s."""


class ThrottledLogger:
    """Logs a warning with the same key at most once every five seconds.

    Args:
        logger: logger that receives the warnings.
    """

    def __init__(self, logger: logging.Logger) -> None:
        self._logger = logger
        self._logged: dict[str, float] = {}

    def warning(self, key: str, message: str, *values: object) -> None:
        """Logs a warning, unless one with the same key was logged recently.

        Args:
            key: key of the warning.
            message: format string of the warning.
            values: values for the format string.
        """
        if time.monotonic() - self._logged.get(key, -math.inf) > WARNING_INTERVAL:
            self._logged[key] = time.monotonic()
            self._logger.warning(message, *values)
