# The HTTP service on a CPU.
#
#   docker build --tag trilitenet .
#   docker run --rm --publish 127.0.0.1:8000:8000 --read-only --tmpfs /tmp trilitenet
#
# An artefact or weights of the folder it is called in: --volume "$PWD":/models:ro before the image's name, and after it
# --model /models/tiny.xml. Another port: --publish 127.0.0.1:9000:8000; HEALTHCHECK asks 8000, so leave --port alone.
#
# On a GPU: --build-arg TORCH_INDEX= the index of a CUDA build of PyTorch, and docker run --gpus all.

ARG PYTHON=3.12-slim-bookworm

FROM python:${PYTHON} AS build
ARG TORCH=torch==2.13.0
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
ARG EXTRAS=serve,openvino,onnx
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
WORKDIR /build
RUN python -m venv /opt/trilitenet \
    && /opt/trilitenet/bin/pip install "${TORCH}" --index-url "${TORCH_INDEX}"
COPY pyproject.toml README.md LICENSE LICENSE-WEIGHTS ./
COPY src src
RUN /opt/trilitenet/bin/pip install ".[${EXTRAS}]"

FROM python:${PYTHON}
COPY --from=build /opt/trilitenet /opt/trilitenet
RUN useradd --uid 10001 --no-create-home --shell /usr/sbin/nologin trilitenet
ENV PATH=/opt/trilitenet/bin:$PATH PYTHONDONTWRITEBYTECODE=1 PYTHONUNBUFFERED=1
USER 10001:10001
WORKDIR /tmp
EXPOSE 8000
STOPSIGNAL SIGTERM
HEALTHCHECK --interval=15s --timeout=5s --start-period=60s --retries=3 \
    CMD ["python", "-c", "import urllib.request; urllib.request.urlopen('http://127.0.0.1:8000/healthz', timeout=4)"]
ENTRYPOINT ["trilitenet", "serve", "--host", "0.0.0.0"]
CMD ["--model", "tiny"]
