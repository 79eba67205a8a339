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
# Debug information would be three quarters of the program; names of functions stay.
ENV CARGO_PROFILE_RELEASE_DEBUG=false
WORKDIR /perturb
# Dependencies first: this layer is built again only when they change. What was compiled of the skeleton's own packages
# is forgotten, since cargo tells old from new by times, and sources may be older than this layer.
COPY --from=skeleton /skeleton .
RUN cargo build --package perturb --release --locked && rm -rf target/release/.fingerprint/perturb*
COPY . .
# The commit, which the program tells: the repository is not in the build's context.
ARG PERTURB_COMMIT="unknown commit"
RUN cargo build --package perturb --release --locked

FROM debian:bookworm-slim
# 1: with what rendering through EGL needs, in software.
ARG RENDERING=0
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libmujoco2.2.2 \
        $([ "$RENDERING" = 0 ] || echo libegl1 libgl1-mesa-dri) \
    && rm -rf /var/lib/apt/lists/* /var/cache/apt/* \
    && useradd --uid 10001 --user-group --no-create-home --home-dir / --shell /usr/sbin/nologin perturb
COPY --from=build /perturb/target/release/perturb-server /usr/local/bin/
# Sessions must be through with the shutdown before `docker stop` loses its patience, which is after ten seconds.
# A container's port is reached by those alone whom its network lets in; docker/README.md says how to guard it.
ENV PERTURB_SERVER_LISTEN=tcp://0.0.0.0:7447 PERTURB_SERVER_INSECURE=true PERTURB_SERVER_GRACE_SECONDS=8
USER perturb
EXPOSE 7447
STOPSIGNAL SIGTERM
HEALTHCHECK --interval=5s --timeout=5s --retries=3 CMD ["perturb-server", "--health"]
ENTRYPOINT ["perturb-server"]
