# The program perturb-server with MuJoCo, without libtorch. From the repository's root:
#   docker build --file docker/server.Dockerfile --tag perturb-server .

FROM rust:1.95-bookworm AS skeleton
WORKDIR /perturb
COPY . .
RUN docker/skeleton.sh /skeleton

FROM rust:1.95-bookworm AS build
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libmujoco-dev pkg-config \
    && rm -rf /var/lib/apt/lists/*
# Debug information would be three quarters of the program.
ENV CARGO_PROFILE_RELEASE_DEBUG=false
WORKDIR /perturb
# Dependencies first: this layer is built again only when they change. The compiled packages of the skeleton are removed,
# because cargo compares times, and the sources may be older than this layer.
COPY --from=skeleton /skeleton .
RUN cargo build --package perturb --release --locked && rm -rf target/release/.fingerprint/perturb*
COPY . .
# The commit, which the program reports: the repository is not in the build's context.
ARG PERTURB_COMMIT="unknown commit"
# As `make install` does. Panics still name file and line.
RUN cargo build --package perturb --release --locked && strip target/release/perturb-server

FROM debian:bookworm-slim
# 1: with OpenGL in software, which drawing Hopper and HalfCheetah needs.
ARG RENDERING=0
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libmujoco2.2.2 \
        $([ "$RENDERING" = 0 ] || echo libegl1 libgl1-mesa-dri) \
    && rm -rf /var/lib/apt/lists/* /var/cache/apt/* \
    && useradd --uid 10001 --user-group --no-create-home --home-dir / --shell /usr/sbin/nologin perturb
COPY --from=build /perturb/target/release/perturb-server /usr/local/bin/
# The shutdown must be complete before `docker stop` kills, after ten seconds. The container's network decides who reaches
# its port; docker/README.md says how to guard it.
ENV PERTURB_SERVER_LISTEN=tcp://0.0.0.0:7447 PERTURB_SERVER_INSECURE=true PERTURB_SERVER_GRACE_SECONDS=8
USER perturb
EXPOSE 7447
STOPSIGNAL SIGTERM
HEALTHCHECK --interval=5s --timeout=5s --retries=3 CMD ["perturb-server", "--health"]
ENTRYPOINT ["perturb-server"]
