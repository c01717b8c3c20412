"""The Ray cluster that rollouts can be made on."""

from __future__ import annotations

import logging
import os
from functools import partial


def connect() -> int:
    """Connects to a Ray cluster: the one at ``RAY_ADDRESS``, else one that runs on this machine, else a new one here.

    May be called again.

    Returns:
        Processors of the cluster.

    Raises:
        ImportError: without Ray.
        ConnectionError: if no cluster answers at ``RAY_ADDRESS``.
    """
    try:
        import ray
    except ImportError as error:
        raise ImportError('backend "ray" needs Ray: pip install "rover_rl[ray]"') from error
    if not ray.is_initialized():
        # What remote workers print would go through the progress bar; how they end is in the error.
        init = partial(ray.init, log_to_driver=False, logging_level=logging.ERROR)
        try:
            init(address="auto")
        except ConnectionError as error:
            if "RAY_ADDRESS" in os.environ:
                raise ConnectionError(
                    f"no Ray cluster answers at RAY_ADDRESS={os.environ['RAY_ADDRESS']}; "
                    "if it asks for a token, set RAY_AUTH_MODE=token and have its ~/.ray/auth_token here"
                ) from error
            init(include_dashboard=False)
    return int(ray.cluster_resources().get("CPU", 0))
