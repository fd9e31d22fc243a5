# syntax=docker/dockerfile:1
# docker build --target cpu -t scan2sim:cpu .     (or --target gpu -t scan2sim:gpu)
FROM python:3.11-slim AS system
COPY packages.txt /tmp/
RUN apt-get update \
    && xargs -a /tmp/packages.txt apt-get install -y --no-install-recommends \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --create-home --uid 1000 scan2sim \
    && install -d -o scan2sim -g scan2sim /data /home/scan2sim/.cache
ENV PATH=/opt/venv/bin:$PATH PYTHONUNBUFFERED=1 DO_NOT_TRACK=1
WORKDIR /app

FROM system AS code
RUN python -m venv /opt/venv
COPY . .
# a checkout with umask 077 can be read by its owner only
RUN chmod -R a+rX .

# without torch, which installs gigabytes of CUDA: reconstruction, videos and surveys don't need it
FROM code AS cpu-environment
RUN pip install --no-cache-dir -c constraints.txt -e '.[slam,ray,s3,bus]'

FROM code AS gpu-environment
RUN pip install --no-cache-dir -c constraints.txt -e '.[segmentation,slam,ray,s3,bus]'

FROM system AS gpu
ENV NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=compute,utility
COPY --from=gpu-environment /opt/venv /opt/venv
COPY --from=gpu-environment /app /app
# scan2sim, as a number: Kubernetes can't check that a name isn't root
USER 1000
ENTRYPOINT ["/app/deploy/entrypoint"]
CMD ["--help"]

FROM system AS cpu
COPY --from=cpu-environment /opt/venv /opt/venv
COPY --from=cpu-environment /app /app
# scan2sim, as a number: Kubernetes can't check that a name isn't root
USER 1000
ENTRYPOINT ["/app/deploy/entrypoint"]
CMD ["--help"]
