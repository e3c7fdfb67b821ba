# syntax=docker/dockerfile:1
# The two commands of the README in a container:
#
#   docker build -t wasp .
#   docker run --rm wasp                                    # the main job: wasp run quickstart
#   docker run --rm wasp sh -c 'pip install nox && nox'     # the tests
#
# With a GPU, on any base of Debian or Ubuntu with Python 3.11 to 3.13:
#
#   docker build -t wasp --build-arg BASE=nvidia/cuda:13.0.1-base-ubuntu24.04 --build-arg INDEX= .
#   docker run --rm --gpus all wasp
ARG BASE=debian:trixie-slim
FROM ${BASE}

# Tests of provenance make git repositories.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends ca-certificates git python3 python3-venv \
    && rm -rf /var/lib/apt/lists/*

# The system's own Python takes no packages.
ENV PATH=/opt/venv/bin:$PATH
RUN python3 -m venv /opt/venv

# Where pip looks beside PyPI. Here is torch's CPU build; PyPI's has gigabytes of CUDA.
ARG INDEX=https://download.pytorch.org/whl/cpu
ENV PIP_EXTRA_INDEX_URL=${INDEX}

WORKDIR /wasp
COPY . .
RUN --mount=type=cache,target=/root/.cache/pip pip install -e .

CMD ["wasp", "run", "quickstart"]
