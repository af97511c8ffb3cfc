# One image for every process of a run: the launcher by default, or
#   docker run --entrypoint python IMAGE -m duio_mesh.node --spec /spec/node-3.spec     (docs/deploy.md)
FROM python:3.12-slim AS build
WORKDIR /src
COPY pyproject.toml README.md LICENSE ./
COPY duio_mesh ./duio_mesh
RUN pip install --no-cache-dir build && python -m build --wheel --outdir /wheel

FROM python:3.12-slim
COPY --from=build /wheel /wheel
COPY constraints.txt /wheel/
RUN pip install --no-cache-dir -c /wheel/constraints.txt /wheel/*.whl && rm -r /wheel \
    && useradd --create-home --uid 1000 duio
WORKDIR /home/duio
COPY --chown=duio launch.py ./
COPY --chown=duio topologies ./topologies
USER duio
ENTRYPOINT ["python", "launch.py"]
CMD ["topologies/partitioned.yaml"]
