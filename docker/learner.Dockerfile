# An image with the programs perturb and perturb-recurrent, the libraries libtorch and OpenBLAS, which only
# perturb-recurrent needs, and the experiment files. From the repository's root:
#   docker build --file docker/learner.Dockerfile --tag perturb-learner \
#     --build-arg PERTURB_COMMIT=$(git rev-parse --short=12 HEAD) .
# With `--build-arg RECURRENT=0` the image has no perturb-recurrent and no libtorch.

FROM rust:1.95-bookworm AS skeleton
WORKDIR /perturb
COPY . .
RUN docker/skeleton.sh /skeleton

FROM rust:1.95-bookworm AS build
# 1 includes perturb-recurrent, which trains recurrent policies and needs libtorch. 0 leaves it out.
ARG RECURRENT=1
RUN [ "$RECURRENT" = 0 ] || { \
        apt-get update \
        && apt-get install --yes --no-install-recommends libopenblas0-pthread libtorch-dev \
        && rm -rf /var/lib/apt/lists/*; \
    }
# Build without debug information, which would be nine tenths of the program's size.
ENV CARGO_PROFILE_RELEASE_DEBUG=false
WORKDIR /perturb
# Compile the dependencies in a layer of their own, as in server.Dockerfile. libtorch's bindings take minutes.
COPY --from=skeleton /skeleton .
RUN cargo build --package perturb-cli $([ "$RECURRENT" = 0 ] || echo --package perturb-recurrent) --release --locked \
    && rm -rf target/release/.fingerprint/perturb*
COPY . .
# The commit that results will state. It is an argument, because the build's context does not contain the git history.
ARG PERTURB_COMMIT="unknown commit"
RUN cargo build --package perturb-cli $([ "$RECURRENT" = 0 ] || echo --package perturb-recurrent) --release --locked \
    && mkdir /programs /libraries \
    && cp target/release/perturb $([ "$RECURRENT" = 0 ] || echo target/release/perturb-recurrent) /programs \
    && strip /programs/*
# Copy only the shared libraries that the programs load: some 280, nearly all of them dependencies of libtorch. Debian's
# packages would add 360 MB of files that are not loaded. The C library is left out, because the image has its own.
RUN ldd /programs/* | awk '$3 ~ "^/" { print $3 }' | sort -u | grep -vE '/lib(c|m|dl|pthread|rt|resolv)\.so' \
    | xargs --no-run-if-empty cp --dereference --target-directory /libraries

FROM debian:bookworm-slim
COPY --from=build /libraries /usr/local/lib/
RUN ldconfig && useradd --uid 10001 --user-group --no-create-home --home-dir / --shell /usr/sbin/nologin perturb
COPY --from=build /programs /usr/local/bin/
COPY experiments /experiments
# OpenBLAS computes matrix products with one thread. The learner starts threads itself, and more would slow it down.
ENV OPENBLAS_NUM_THREADS=1
USER perturb
STOPSIGNAL SIGTERM
ENTRYPOINT ["perturb"]
