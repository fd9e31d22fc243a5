# syntax=docker/dockerfile:1
# docker build -f deploy/toolboxes/movement.Dockerfile -t scan2sim-movement .     (after base.Dockerfile)
FROM scan2sim-toolbox
COPY constraints.txt deploy/toolboxes/movement.txt /requirements/
USER root
RUN pip install --no-cache-dir -c /requirements/constraints.txt -r /requirements/movement.txt
USER 1000
HEALTHCHECK --interval=10s --timeout=5s --start-period=60s CMD ["python", "-m", "scan2sim.services.http.healthcheck"]
ENTRYPOINT ["scan2sim", "toolbox", "serve", "movement", "--host", "0.0.0.0"]
