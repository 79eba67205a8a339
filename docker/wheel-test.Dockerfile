# A Debian with Python and nothing to compile with, in which `make wheel-test` installs the wheel.
FROM debian:bookworm-slim
RUN apt-get update \
    && apt-get install --yes --no-install-recommends python3 python3-venv \
    && rm -rf /var/lib/apt/lists/*
