# Four images from one file: controller (also router and plant; no torch), recorder, trainer (no CasADi) and worker
# (scheduler and workers of a sweep; torch, CasADi and a compiler).
# pip's usual variables pass through as build arguments: PIP_INDEX_URL, PIP_EXTRA_INDEX_URL, PIP_FIND_LINKS.
# No compiler is in the other three: see "The solver in a container" in docs/tutorials/compose.md.

FROM python:3.11-slim AS base
# The root file system is read-only and the user has no home: what wants to write a cache writes to /tmp.
ENV PATH=/opt/tandem/bin:$PATH HOME=/tmp PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1
RUN useradd --system --uid 10001 --user-group --no-create-home --home-dir /tmp tandem

FROM base AS build
ARG PIP_INDEX_URL
ARG PIP_EXTRA_INDEX_URL
ARG PIP_FIND_LINKS
# The older builder forgets arguments in stages that build on this one; it remembers the environment.
ENV PIP_INDEX_URL=$PIP_INDEX_URL PIP_EXTRA_INDEX_URL=$PIP_EXTRA_INDEX_URL PIP_FIND_LINKS=$PIP_FIND_LINKS
WORKDIR /build
RUN python -m venv --without-pip /opt/tandem
COPY pyproject.toml docker/requirements.py ./
RUN python requirements.py .

FROM build AS wheel
COPY . ./
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheel .

FROM build AS controller-build
RUN pip --python /opt/tandem/bin/python install --no-cache-dir -r controller.txt
COPY --from=wheel /wheel /wheel
COPY docker/slim.py ./
RUN pip --python /opt/tandem/bin/python install --no-cache-dir --no-deps /wheel/*.whl && python slim.py /opt/tandem

FROM base AS controller
COPY --from=controller-build /opt/tandem /opt/tandem
# A new volume takes its owner from here.
RUN mkdir /memory && chown 10001:10001 /memory
USER 10001:10001
WORKDIR /tmp
ENTRYPOINT ["tandem"]

FROM build AS recorder-build
RUN pip --python /opt/tandem/bin/python install --no-cache-dir -r recorder.txt
COPY --from=wheel /wheel /wheel
COPY docker/slim.py ./
RUN pip --python /opt/tandem/bin/python install --no-cache-dir --no-deps /wheel/*.whl && python slim.py /opt/tandem

FROM base AS recorder
COPY --from=recorder-build /opt/tandem /opt/tandem
# A new volume takes its owner from here.
RUN mkdir /logs && chown 10001:10001 /logs
USER 10001:10001
WORKDIR /logs
ENTRYPOINT ["tandem"]

FROM build AS trainer-build
RUN pip --python /opt/tandem/bin/python install --no-cache-dir -r trainer.txt
COPY --from=wheel /wheel /wheel
COPY docker/slim.py ./
RUN pip --python /opt/tandem/bin/python install --no-cache-dir --no-deps /wheel/*.whl && python slim.py /opt/tandem

FROM base AS trainer
COPY --from=trainer-build /opt/tandem /opt/tandem
USER 10001:10001
WORKDIR /tmp
ENTRYPOINT ["tandem"]

FROM build AS worker-build
RUN pip --python /opt/tandem/bin/python install --no-cache-dir -r worker.txt
COPY --from=wheel /wheel /wheel
COPY docker/slim.py ./
RUN pip --python /opt/tandem/bin/python install --no-cache-dir --no-deps /wheel/*.whl && python slim.py /opt/tandem

FROM base AS worker
# A run of a sweep solves thousands of problems: the compiled solver is four times as fast.
RUN apt-get update && apt-get install -y --no-install-recommends gcc libc6-dev && rm -rf /var/lib/apt/lists/*
COPY --from=worker-build /opt/tandem /opt/tandem
# A new volume takes its owner from here.
RUN mkdir /cache && chown 10001:10001 /cache
ENV XDG_CACHE_HOME=/cache
USER 10001:10001
WORKDIR /tmp
ENTRYPOINT ["dask"]
