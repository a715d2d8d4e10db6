# modetune with CalculiX, run by an ordinary user, with the packages of tools/requirements.txt:
#   docker build -t modetune .
#   docker run --rm -v "$PWD":/campaigns modetune update campaign.yaml
FROM debian:12-slim@sha256:88200866dfff7ea7f5cbcb6ec7c8a701889efe6fe859fe64d6990e4b07ea4171 AS build
RUN apt-get update \
 && apt-get install -y --no-install-recommends python3 python3-venv \
 && rm -rf /var/lib/apt/lists/*
WORKDIR /src
COPY pyproject.toml README.md LICENSE tools/requirements.txt ./
COPY src src
COPY core core
COPY adapters adapters
COPY flows flows
COPY configs configs
RUN python3 -m venv /opt/modetune \
 && /opt/modetune/bin/pip install --no-cache-dir \
    --no-deps --require-hashes --requirement requirements.txt \
 && /opt/modetune/bin/pip install --no-cache-dir --no-deps --no-build-isolation .

FROM debian:12-slim@sha256:88200866dfff7ea7f5cbcb6ec7c8a701889efe6fe859fe64d6990e4b07ea4171
RUN apt-get update \
 && apt-get install -y --no-install-recommends python3 calculix-ccx libosmesa6 \
    libmumps-headers-dev libmumps-seq-5.5 \
 && rm -rf /var/lib/apt/lists/* \
 && useradd --create-home modetune \
 && mkdir /campaigns && chown modetune /campaigns
COPY --from=build /opt/modetune /opt/modetune
ENV PATH=/opt/modetune/bin:$PATH
USER modetune
WORKDIR /campaigns
ENTRYPOINT ["modetune"]
CMD ["--help"]
