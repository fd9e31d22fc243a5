# syntax=docker/dockerfile:1
# docker build -f deploy/toolboxes/classify.Dockerfile -t scan2sim-classify .     (after base.Dockerfile)
# torch exports the network as ONNX in a stage of its own, and isn't part of the image
FROM scan2sim-toolbox AS network
COPY constraints.txt deploy/toolboxes/imagenet.txt /requirements/
USER root
RUN pip install --no-cache-dir -c /requirements/constraints.txt -r /requirements/imagenet.txt
RUN python -m scan2sim.services.toolboxes.detector.imagenet /models/efficientnet-lite0.onnx

FROM scan2sim-toolbox
COPY --from=network /models /models
HEALTHCHECK --interval=10s --timeout=5s --start-period=60s CMD ["python", "-m", "scan2sim.services.http.healthcheck"]
ENTRYPOINT ["scan2sim", "toolbox", "serve", "classify", "--host", "0.0.0.0", \
    "--set", "weights=/models/efficientnet-lite0.onnx"]
