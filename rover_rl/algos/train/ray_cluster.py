"""Connection to a Ray cluster for data collection."""

from __future__ import annotations

import logging
import os
from functools import partial


def connect() -> int:
    """Connects to the Ray cluster at ``RAY_ADDRESS``, else to one on this machine, else starts one. Idempotent.

    Returns:
        Number of CPU cores of the cluster.

    Raises:
        ImportError: if Ray is not installed.
        ConnectionError: if no cluster answers at ``RAY_ADDRESS``.
    """
    try:
        import ray
    except ImportError as error:
        raise ImportError('backend "ray" needs Ray: pip install "rover_rl[ray]"') from error
    if not ray.is_initialized():
        # The output of remote workers would disturb the progress bar. Their errors are reported separately.
        init = partial(ray.init, log_to_driver=False, logging_level=logging.ERROR)
        try:
            init(address="auto")
        except ConnectionError as error:
            if "RAY_ADDRESS" in os.environ:
                raise ConnectionError(
                    f"no Ray cluster answers at RAY_ADDRESS={os.environ['RAY_ADDRESS']}; "
                    "if it requires a token, set RAY_AUTH_MODE=token and copy its ~/.ray/auth_token to this machine"
                ) from error
            init(include_dashboard=False)
    return int(ray.cluster_resources().get("CPU", 0))
