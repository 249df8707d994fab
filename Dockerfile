# The command sb3-cure on a machine without a GPU. Checked by hadolint alone: it has not been built.
#   docker build -t sb3-cure .
#   docker run --rm -v "$PWD/logs:/home/cure/logs" sb3-cure train --env dmc_pixels/cartpole-swingup-v0 \
#       --conf-file fast/cure_sac_ae
FROM python:3.11-slim

# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends libegl1 libopengl0 libgl1-mesa-dri \
    && rm -rf /var/lib/apt/lists/*
COPY setup.cfg pyproject.toml README.md LICENSE constraints.txt /opt/sb3_cure/
COPY sb3_cure /opt/sb3_cure/sb3_cure
COPY zoo_configs /opt/sb3_cure/zoo_configs
RUN PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu pip install --no-cache-dir \
        "/opt/sb3_cure[experiments]" -c /opt/sb3_cure/constraints.txt \
    && useradd --create-home --uid 1000 cure
USER 1000
WORKDIR /home/cure
ENV MUJOCO_GL=egl
ENTRYPOINT ["sb3-cure"]
CMD ["--help"]
