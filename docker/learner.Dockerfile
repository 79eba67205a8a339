# The programs perturb and, with libtorch and OpenBLAS, perturb-recurrent, and the experiments. From the repository's root:
#   docker build --file docker/learner.Dockerfile --tag perturb-learner \
#     --build-arg PERTURB_COMMIT=$(git rev-parse --short=12 HEAD) .

FROM rust:1.95-bookworm AS skeleton
WORKDIR /perturb
COPY . .
RUN docker/skeleton.sh /skeleton

FROM rust:1.95-bookworm AS build
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libopenblas0-pthread libtorch-dev \
    && rm -rf /var/lib/apt/lists/*
# Debug information would be nine tenths of the program; names of functions stay.
ENV CARGO_PROFILE_RELEASE_DEBUG=false
WORKDIR /perturb
# Dependencies first, as in server.Dockerfile: libtorch's bindings take minutes.
COPY --from=skeleton /skeleton .
RUN cargo build --package perturb-cli --release --locked && rm -rf target/release/.fingerprint/perturb*
COPY . .
# The commit, which results name: the repository is not in the build's context.
ARG PERTURB_COMMIT="unknown commit"
RUN cargo build --package perturb-cli --release --locked
# The shared libraries that the programs load: some 280, nearly all of them because libtorch does. Debian's packages
# would bring 360 MB more, which nobody loads. The C library is left out: the image has its own.
RUN mkdir /libraries \
    && ldd target/release/perturb-recurrent | awk '$3 ~ "^/" { print $3 }' | grep -vE '/lib(c|m|dl|pthread|rt|resolv)\.so' \
    | xargs cp --dereference --target-directory /libraries

FROM debian:bookworm-slim
COPY --from=build /libraries /usr/local/lib/
RUN ldconfig && useradd --uid 10001 --user-group --no-create-home --home-dir / --shell /usr/sbin/nologin perturb
COPY --from=build /perturb/target/release/perturb /perturb/target/release/perturb-recurrent /usr/local/bin/
COPY experiments /experiments
# The learner's threads are its own; more inside matrix products only get in their way.
ENV OPENBLAS_NUM_THREADS=1
USER perturb
STOPSIGNAL SIGTERM
ENTRYPOINT ["perturb"]
