# syntax=docker/dockerfile:1
# docker build -f deploy/toolboxes/base.Dockerfile -t scan2sim-toolbox .
# Base image of the four toolboxes; each has its own file.
FROM python:3.11-slim AS environment
RUN python -m venv /opt/venv
ENV PATH=/opt/venv/bin:$PATH
COPY constraints.txt deploy/toolboxes/toolbox.txt /requirements/
RUN pip install --no-cache-dir -c /requirements/constraints.txt -r /requirements/toolbox.txt
COPY . /source
RUN pip install --no-cache-dir --no-deps /source

FROM python:3.11-slim
RUN useradd --create-home --uid 1000 scan2sim
COPY --from=environment /opt/venv /opt/venv
ENV PATH=/opt/venv/bin:$PATH PYTHONUNBUFFERED=1
USER 1000
WORKDIR /home/scan2sim
EXPOSE 8080
