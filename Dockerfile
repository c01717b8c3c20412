# rover_rl with everything that the demo and the tests need, on the CPU. To build it, run the demo and run the tests:
#
#     docker build -t rover_rl .
#     mkdir -p runs && docker run --rm --user "$(id -u):$(id -g)" -v "$PWD/runs:/rover_rl/runs" rover_rl
#     docker run --rm --shm-size=1g rover_rl make test
#
# The demo writes to the mounted folder runs.

FROM python:3.12-slim AS base
RUN apt-get update && apt-get install -y --no-install-recommends make && rm -rf /var/lib/apt/lists/*
WORKDIR /rover_rl

FROM base AS build
# PyBullet is compiled where it has no wheels, such as on aarch64.
RUN [ "$(uname -m)" = x86_64 ] || { apt-get update && apt-get install -y --no-install-recommends g++; }
# The index of PyTorch's builds for CPUs. Those of PyPI bring CUDA, which takes gigabytes.
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
COPY requirements.lock ./
RUN python -m venv .venv \
    && .venv/bin/pip install --no-cache-dir --no-deps --index-url "$TORCH_INDEX" "$(grep '^torch==' requirements.lock)" \
    && .venv/bin/pip install --no-cache-dir -r requirements.lock
COPY . .
RUN make venv

FROM base
RUN useradd --create-home rover && chown rover:rover /rover_rl
COPY --from=build --chown=rover:rover /rover_rl ./
USER rover
# Caches go to /tmp, and the user has a name, so that --user may give any number.
ENV PATH=/rover_rl/.venv/bin:$PATH HOME=/tmp USER=rover
CMD ["rover-rl", "demo"]
