# An image with the program perturb-server and MuJoCo, but without libtorch. From the repository's root:
#   docker build --file docker/server.Dockerfile --tag perturb-server .

FROM rust:1.95-bookworm AS skeleton
WORKDIR /perturb
COPY . .
RUN docker/skeleton.sh /skeleton

FROM rust:1.95-bookworm AS build
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libmujoco-dev pkg-config \
    && rm -rf /var/lib/apt/lists/*
# Build without debug information, which would be three quarters of the program's size.
ENV CARGO_PROFILE_RELEASE_DEBUG=false
WORKDIR /perturb
# Compile the dependencies in a layer of their own, which Docker builds again only when they change. Remove the compiled
# empty packages of the skeleton: cargo compares file times, and would keep them if the real sources are older.
COPY --from=skeleton /skeleton .
RUN cargo build --package perturb --release --locked && rm -rf target/release/.fingerprint/perturb*
COPY . .
# The commit that the program reports. It is an argument, because the build's context does not contain the git history.
ARG PERTURB_COMMIT="unknown commit"
# Remove symbols with `strip`, as `make install` does. Messages of panics still name file and line.
RUN cargo build --package perturb --release --locked && strip target/release/perturb-server

FROM debian:bookworm-slim
# 1 includes OpenGL in software, which is needed to draw Hopper and HalfCheetah. 0 leaves it out.
ARG RENDERING=0
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libmujoco2.2.2 \
        $([ "$RENDERING" = 0 ] || echo libegl1 libgl1-mesa-dri) \
    && rm -rf /var/lib/apt/lists/* /var/cache/apt/* \
    && useradd --uid 10001 --user-group --no-create-home --home-dir / --shell /usr/sbin/nologin perturb
COPY --from=build /perturb/target/release/perturb-server /usr/local/bin/
# The grace period is 8 s, because `docker stop` kills the server after ten seconds. The server accepts all clients of
# the container's network; docker/README.md describes how to require tokens and TLS.
ENV PERTURB_SERVER_LISTEN=tcp://0.0.0.0:7447 PERTURB_SERVER_INSECURE=true PERTURB_SERVER_GRACE_SECONDS=8
USER perturb
EXPOSE 7447
STOPSIGNAL SIGTERM
HEALTHCHECK --interval=5s --timeout=5s --retries=3 CMD ["perturb-server", "--health"]
ENTRYPOINT ["perturb-server"]
