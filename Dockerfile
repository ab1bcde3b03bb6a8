# The packages, then all that a run reads; it ends in the README's two commands.
#   docker build --build-arg TORCH=ADDRESS -t lifelong .                            ADDRESS: PyTorch's CPU index, see README
#   docker run --rm -v "$PWD/figures/latest:/lifelong/figures/latest" lifelong      the first command: run
#   docker run --rm lifelong test                                                   the second
FROM python:3.11-slim AS packages
# Where pip finds torch's wheels without GPU libraries. Without it the image is 3 GB larger and does the same.
ARG TORCH=""
WORKDIR /lifelong
COPY environment.txt .
RUN python -m venv .venv && PIP_EXTRA_INDEX_URL="$TORCH" .venv/bin/pip install --no-cache-dir -r environment.txt \
    && cp environment.txt .venv/installed.txt

FROM python:3.11-slim
# What SUMO's library loads; git is for the tests. The history stays outside, so that runs in here know no commit.
RUN apt-get update && apt-get install --yes --no-install-recommends \
    git libatomic1 libexpat1 libgl1 libxext6 libxrender1 && rm -rf /var/lib/apt/lists/*
WORKDIR /lifelong
COPY --from=packages /lifelong/.venv .venv
COPY README.md CONTRIBUTING.md DEVIATIONS.md CHANGELOG.md CITATION.cff LICENSE Dockerfile ./
COPY pyproject.toml environment.txt reproduce.sh .gitignore .gitattributes ./
COPY .ci .ci
COPY lifelong_lib lifelong_lib
COPY notebooks notebooks
COPY tests tests
COPY data data
COPY figures/reference figures/reference
ENTRYPOINT ["./reproduce.sh"]
CMD ["run"]
