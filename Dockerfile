# sb3-mcbs with RL Zoo's commands, for processors:
#   docker build -t sb3-mcbs .
#   mkdir -p logs
#   docker run --rm --user "$(id -u)" -v "$PWD/logs:/work/logs" sb3-mcbs train --algo mcbs_crossq --env HalfCheetah-v5
# For a GPU of NVIDIA: docker build --build-arg TORCH_INDEX=https://pypi.org/simple, and docker run --gpus all.
ARG PYTHON=3.11
FROM python:${PYTHON}-slim

ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu

# Rendering without a screen: by EGL, since OSMesa crashes beside a CUDA build of PyTorch.
RUN apt-get update \
    && apt-get install -y --no-install-recommends libegl1 libgl1 \
    && rm -rf /var/lib/apt/lists/*
ENV MUJOCO_GL=egl PYOPENGL_PLATFORM=egl PIP_NO_CACHE_DIR=1

# The large packages first, so that a change of the code does not install them again.
COPY constraints.txt /tmp/
RUN pip install --index-url ${TORCH_INDEX} "$(grep '^torch==' /tmp/constraints.txt)"

COPY . /src
RUN pip install -c /tmp/constraints.txt "/src[zoo,plots,report,video,hub,onnx]" && rm -rf /src

# Any user may be given to docker run, who then owns what is written to logs/; caches go to /tmp.
ENV HOME=/tmp USER=user
RUN useradd --no-create-home user && mkdir --mode 1777 /work
USER user
WORKDIR /work
ENTRYPOINT ["sb3-mcbs"]
CMD ["--help"]
