# syntax=docker/dockerfile:1
# docker build -f deploy/toolboxes/segment.Dockerfile -t scan2sim-segment .     (after base.Dockerfile)
FROM scan2sim-toolbox
HEALTHCHECK --interval=10s --timeout=5s --start-period=60s CMD ["python", "-m", "scan2sim.services.http.healthcheck"]
ENTRYPOINT ["scan2sim", "toolbox", "serve", "segment", "--host", "0.0.0.0"]
