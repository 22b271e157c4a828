# Not built yet: no container daemon was at hand. It runs `make setup`, which is tested.
# The whole project for the CPU. For an NVIDIA GPU: docker build --build-arg TORCH=lock . and docker run --gpus all
FROM python:3.11-slim-bookworm
# git: commits in the dev container; libegl1, libgl1: films and pictures; libglib2.0-0: OpenCV
RUN apt-get update \
 && apt-get install -y --no-install-recommends git make libegl1 libgl1 libglib2.0-0 \
 && rm -rf /var/lib/apt/lists/*
WORKDIR /brokk_rl
ARG TORCH=cpu
# the packages first: a change of the code does not install them again
COPY pyproject.toml uv.lock Makefile README.md ./
RUN mkdir brokk_rl conf tasks actuators perception deploy diagnosis exam study \
 && UV_NO_CACHE=1 make setup TORCH=$TORCH
COPY . .
RUN touch .venv/.synced
ENV PATH=/brokk_rl/.venv/bin:$PATH
CMD ["brokk", "--help"]
