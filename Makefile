# perturb's commands; `make` alone lists them. Each installs what it lacks and can be run again.

# Debian 12's packages: a compiler, MuJoCo.
PACKAGES := build-essential pkg-config libmujoco-dev
# `make generate`, and the test that generated files are up to date, read MuJoCo's headers with libclang.
CLANG_PACKAGES := libclang-dev
# perturb-recurrent needs libtorch and a BLAS that is not the slow reference one.
TORCH_PACKAGES := libtorch-dev libopenblas0-pthread
# What draws Hopper and HalfCheetah: OpenGL without a display, in software. The server runs without it.
OPENGL := libegl1 libgl1-mesa-dri
# A whole Slurm on one machine, for its test.
SLURM_PACKAGES := slurmctld slurmd slurm-client munge
# The clients in C++ and Go in examples/clients, for their test.
LANGUAGE_PACKAGES := g++ pkg-config protobuf-compiler protobuf-compiler-grpc libgrpc++-dev golang-go golang-google-grpc-dev \
	golang-github-golang-protobuf-1-5-dev protoc-gen-go protoc-gen-go-grpc
# Emulates other processors, for the test that all compute the same.
QEMU := qemu-user
# Has clocks jump, for a test.
FAKETIME := libfaketime
# What encodes the .mp4 files of `perturb video`, some 60 MB; everything else but the site runs without it.
FFMPEG := ffmpeg
# Packages that perturb-server and perturb compile in two versions: ring, ahash and tempfile each need another getrandom, and
# prometheus-client, whose version 0.25.0 does not escape labels, needs syn 3.
TWICE := getrandom|syn
CARGO_DENY_VERSION := 0.20.2
TARGET := $(or $(CARGO_TARGET_DIR),target)
PROGRAMS := $(TARGET)/release
# The Python package's tools are in an environment of their own.
VENV := $(TARGET)/python
# The Python package whose compliance cases `make test` runs.
DM_ENV_RPC := $(TARGET)/dm_env_rpc
# The Python package whose models of MuJoCo `make test` compares tasks with.
GYMNASIUM := $(TARGET)/gymnasium
# The Python environment with buf, which checks the contract.
BUF := $(TARGET)/buf
# The Python environment with the schemas of Kubernetes.
KUBERNETES := $(TARGET)/kubernetes
# The site and what builds it.
DOCS := $(TARGET)/docs
# What perturb's training is compared with. PUREJAXRL is an address that git can clone, or where GitHub is out of reach the
# path of a clone.
PEERS := $(TARGET)/peers
PUREJAXRL ?= https://github.com/luchris429/purejaxrl
PUREJAXRL_COMMIT := 31756b197773a52db763fdbe6d635e4b46522a73

# Arguments of `make demo`, `make bench`, `make bench-peers` and `make all-pairs`, e.g.
# make demo DEMO_ARGS="--episodes 200 --test-episodes 50", make bench-python BENCH_PYTHON_ARGS="--rounds 9 CartPole",
# make bench-peers PEERS_ARGS="--rounds 1 HalfCheetah",
# make all-pairs ALL_PAIRS_ARGS="20 /tmp/runs": episodes, directory.
DEMO_ARGS ?=
# Where `make install` puts things.
PREFIX ?= $(HOME)/.local
ALL_PAIRS_ARGS ?=
BENCH_ARGS ?=
BENCH_PYTHON_ARGS ?=
PEERS_ARGS ?=
# More arguments for `docker build`, e.g. make docker DOCKER_ARGS="--build-arg RENDERING=1".
DOCKER_ARGS ?=
# What the images are made from.
BASE_IMAGES := debian:bookworm-slim rust:1.95-bookworm

# The learner's threads are its own; more inside libtorch's matrix products only get in their way.
export OPENBLAS_NUM_THREADS := 1

# One profile and one selection of packages for programs, tests, lints and benches. Cargo chooses the features of
# dependencies by the selection of packages, so that what `make build` compiles is not compiled again for tests. The second
# form is the server without MuJoCo.
ALL := --workspace --release --locked
WITHOUT_MUJOCO := --package perturb --no-default-features --release --locked
# Its tests look at what the server does, not at how fast it is, and compile in half the time.
WITHOUT_MUJOCO_TEST := $(WITHOUT_MUJOCO) --config profile.release.package.perturb.opt-level=1
# Tests mostly wait, for time-outs and for each other: so many at a time.
TEST_THREADS := $(shell echo $$((3 * $$(nproc))))

# Installs those of the Debian packages $(1) that are missing.
define install
missing=; \
	for package in $(1); do \
		dpkg-query --show --showformat='$${Status}' $$package 2>/dev/null | grep -q 'ok installed' || missing="$$missing $$package"; \
	done; \
	[ -n "$$missing" ] || exit 0; \
	if ! command -v apt-get >/dev/null; then \
		echo "perturb is built on Debian 12, but apt-get is missing here; install the equivalents of:$$missing" >&2; exit 1; \
	fi; \
	if [ "$$(id -u)" = 0 ]; then as_root=; \
	elif command -v sudo >/dev/null; then as_root=sudo; \
	else \
		echo "These packages are missing and neither root nor sudo is at hand; have them installed with: apt-get install$$missing" >&2; exit 1; \
	fi; \
	echo "Installing with apt-get:$$missing"; \
	$$as_root apt-get -q update && $$as_root env DEBIAN_FRONTEND=noninteractive apt-get -qy install --no-install-recommends $$missing
endef

.DEFAULT_GOAL := help
.PHONY: help deps all-deps opengl toolchain build generate recurrent build-all install install-recurrent demo all-pairs results-check report-check serve-test test slurm-test kill-test \
	load-test threads-test bounds-test attack-test faults-test asan-test qemu-test simulation-test slurm-acceptance lint proto-lint proto-baseline bench fuzz fuzz-keep \
	bench-peers audit cargo-deny metrics-test kubernetes-check otel-test python-test interrupts-test wheel wheel-test python-acceptance \
	bench-python python-venv languages-test docs docs-test docker docker-base docker-test

help: ## this list
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 20

deps: toolchain ## install the missing Debian packages, with sudo if need be
	@$(call install,$(PACKAGES))

all-deps: deps
	@$(call install,$(TORCH_PACKAGES) $(CLANG_PACKAGES))

opengl:
	@$(call install,$(OPENGL))

toolchain:
	@command -v cargo >/dev/null || { echo "cargo is missing; install Rust 1.95 or later, see https://rustup.rs" >&2; exit 1; }

build: deps ## compile the programs perturb-server and perturb
	cargo build $(ALL) --bin perturb-server --bin perturb

recurrent: deps ## compile perturb-recurrent too, which trains recurrent policies with libtorch; minutes
	@$(call install,$(TORCH_PACKAGES))
	cargo build $(ALL) --bin perturb-server --bin perturb --bin perturb-recurrent

# What tests, lints and benches of the whole workspace need.
build-all: all-deps
	cargo build $(ALL)

install: build ## copy the programs, manual pages and completions to PREFIX, by default ~/.local
	install -D --target-directory $(PREFIX)/bin $(addprefix $(PROGRAMS)/,perturb perturb-server)
	strip $(PREFIX)/bin/perturb $(PREFIX)/bin/perturb-server
	mkdir -p $(PREFIX)/share/man/man1 $(PREFIX)/share/bash-completion/completions $(PREFIX)/share/zsh/site-functions \
		$(PREFIX)/share/fish/vendor_completions.d
	$(PROGRAMS)/perturb --quiet man $(PREFIX)/share/man/man1
	$(PROGRAMS)/perturb-server --man > $(PREFIX)/share/man/man1/perturb-server.1
	$(PROGRAMS)/perturb completions bash > $(PREFIX)/share/bash-completion/completions/perturb
	$(PROGRAMS)/perturb-server --completions bash > $(PREFIX)/share/bash-completion/completions/perturb-server
	$(PROGRAMS)/perturb completions zsh > $(PREFIX)/share/zsh/site-functions/_perturb
	$(PROGRAMS)/perturb-server --completions zsh > $(PREFIX)/share/zsh/site-functions/_perturb-server
	$(PROGRAMS)/perturb completions fish > $(PREFIX)/share/fish/vendor_completions.d/perturb.fish
	$(PROGRAMS)/perturb-server --completions fish > $(PREFIX)/share/fish/vendor_completions.d/perturb-server.fish
	@echo "installed in $(PREFIX)/bin; if it is not on your PATH: export PATH=$(PREFIX)/bin:\$$PATH"
	@echo "To train recurrent policies too: make install-recurrent"

install-recurrent: recurrent install ## install perturb-recurrent too, which trains recurrent policies with libtorch
	install -D --target-directory $(PREFIX)/bin $(PROGRAMS)/perturb-recurrent
	strip $(PREFIX)/bin/perturb-recurrent

demo: build opengl ## train Hopper on default and on random physics, and see what still works; a minute after compiling
	$(PROGRAMS)/perturb demo $(DEMO_ARGS)

all-pairs: recurrent ## train and test every algorithm and architecture on every environment, shortly
	PROGRAMS=$(PROGRAMS) cli/tests/all_pairs.sh $(ALL_PAIRS_ARGS)

report-check: build ## make the report of a small experiment and look at it in Chromium, which it installs; minutes
	@$(call install,chromium python3)
	PROGRAMS=$(PROGRAMS) cli/tests/report_check.sh $(TARGET)/report-check

serve-test: build opengl ## watch a training and an experiment on the live page in Chromium, which it installs; minutes
	@$(call install,chromium python3)
	python3 cli/tests/serve_check/watch.py chromium $(PROGRAMS) $(TARGET)/serve-test

metrics-test: build opengl ## have a Prometheus, which it installs, watch a server, and ask it for all that Grafana's dashboard shows
	@$(call install,prometheus python3)
	python3 docker/grafana/check.py $(PROGRAMS)

kubernetes-check: $(KUBERNETES)/installed ## check the Kubernetes manifests against Kubernetes' schemas and the server's documents
	@$(call install,prometheus)
	$(KUBERNETES)/bin/python docker/kubernetes/check.py

otel-test: all-deps ## build the server with traces, and test that they come to a collector
	cargo test $(ALL) --features perturb/otel --test server traces::

test: export PERTURB_TEST_DM_ENV_RPC_PYTHON := $(abspath $(DM_ENV_RPC))/bin/python
test: export RUST_TEST_THREADS := $(TEST_THREADS)
test: export PERTURB_TEST_GYMNASIUM_ASSETS := $(abspath $(GYMNASIUM))/gymnasium/envs/mujoco/assets
test: all-deps opengl $(DM_ENV_RPC)/installed $(GYMNASIUM)/installed ## run all tests, then those of the server without MuJoCo
	@$(call install,$(FFMPEG))
	cargo test $(ALL)
	cargo test $(WITHOUT_MUJOCO_TEST)

slurm-test: build-all ## do a plan on a real Slurm of two nodes, started for it, one of which dies
	@$(call install,$(SLURM_PACKAGES))
	PERTURB_SLURM_REQUIRED=1 cargo test $(ALL) --test cli slurm::

load-test: build-all ## a server full of Hoppers for five minutes: 1024 sessions of 16, and one more that is refused
	PERTURB_TEST_FULL_SERVER_SECONDS=$(LOAD_SECONDS) cargo test $(ALL) --test server -- --nocapture hoppers_can_fill_all_places

# The tests of what threads share, once more with two transport threads in servers that do not say how many they have.
threads-test: build-all opengl ## sessions, leases, limits, tokens and shutdowns with two transport threads; minutes
	PERTURB_TEST_TRANSPORT_THREADS=2 cargo test $(ALL) --package perturb --test server -- \
		bounds:: conformance:: determinism:: dm_env_rpc:: faults:: guarded:: leases:: lifecycle:: metrics:: streams::

bounds-test: build-all opengl ## attack a server beside a neighbour, who waits 50 ms at most (p99); on an idle machine
	PERTURB_TEST_NEIGHBOUR_P99_MS=50 cargo test $(ALL) --package perturb --test server -- --nocapture \
		--test-threads 1 bounds::

faults-test: build-all ## lines, disks and clocks with faults, again and again, by a seed that PERTURB_SEED repeats; minutes
	@$(call install,$(FAKETIME))
	for round in $$(seq $(FAULTS_ROUNDS)); do \
		PERTURB_FAKETIME_REQUIRED=1 cargo test $(ALL) --package perturb-cli --test cli -- --nocapture lines:: clocks:: \
			experiments::faults:: && \
		cargo test $(ALL) --package perturb --test server -- --nocapture faults::lines || exit 1; \
	done

kill-test: build-all ## kill servers a hundred times while policies are trained, and compare their weights; minutes
	cargo test $(ALL) --test cli -- --ignored --nocapture a_hundred_kills

qemu-test: build-all ## train on emulated processors, to the same weights as on this one
	@$(call install,$(QEMU))
	PERTURB_QEMU_REQUIRED=1 cargo test $(ALL) --test cli processors::

languages-test: build ## build the clients in C++ and Go, and compare all their replies with the Rust client's; a minute or two
	@$(call install,$(LANGUAGE_PACKAGES))
	cargo build $(ALL) --example client
	examples/clients/compare.sh $(PROGRAMS) $(TARGET)/languages

generate: all-deps ## write the generated files anew, after an edit of a .proto file or of crates/mujoco/src/shim.h
	cargo run --release --locked --package perturb-generate

slurm-acceptance: ## the same with experiments/quick.toml
	PERTURB_SLURM_PLAN=$(CURDIR)/experiments/quick.toml $(MAKE) slurm-test

lint: all-deps cargo-deny proto-lint ## check formatting, the contract, names, import cycles, clippy, documentation and dependencies
	cargo fmt --all --check
	cargo run --quiet --release --locked --package perturb-lint
	cargo clippy $(ALL) --all-targets -- -D warnings
	cargo clippy $(WITHOUT_MUJOCO) --all-targets -- -D warnings
	cargo clippy --release --locked --package perturb-simulation --features turmoil --all-targets -- -D warnings
	RUSTDOCFLAGS="-D warnings" cargo doc $(ALL) --no-deps --lib
	cargo deny --locked check bans licenses sources
	@twice=$$(cargo tree --locked --package perturb --package perturb-cli --edges normal,build --prefix none | \
		awk 'NF { print $$1, $$2 }' | sort -u | cut -d ' ' -f 1 | uniq -d | grep -vxE '$(TWICE)'); \
		[ -z "$$twice" ] || { echo "perturb-server and perturb compile two versions of:" $$twice >&2; exit 1; }

# The baseline holds what clients may rely on. An addition is added to it in the same change.
proto-lint: $(BUF)/installed ## check the contract's style, and that it still says what proto/baseline.binpb says
	cd proto && $(abspath $(BUF))/bin/buf lint
	cd proto && $(abspath $(BUF))/bin/buf breaking --path perturb --against baseline.binpb

proto-baseline: proto-lint ## add what is new in the contract to proto/baseline.binpb
	cd proto && $(abspath $(BUF))/bin/buf build --path perturb --exclude-source-info --output baseline.binpb

bench: export PERTURB_TEST_GYMNASIUM_ASSETS := $(abspath $(GYMNASIUM))/gymnasium/envs/mujoco/assets
bench: build-all opengl $(GYMNASIUM)/installed ## measure throughput, latency and memory
	cargo bench --workspace --locked --bench '*' -- $(BENCH_ARGS)

bench-peers: build $(PEERS)/installed ## measure training beside PureJaxRL and stable-baselines3; gigabytes, minutes
	$(PEERS)/bin/python benches/peers/compare.py --perturb $(PROGRAMS)/perturb --purejaxrl $(PEERS)/purejaxrl $(PEERS_ARGS)

audit: toolchain cargo-deny ## look the dependencies up in the RustSec database, which is downloaded from GitHub
	cargo deny --locked check advisories

cargo-deny: toolchain
	@cargo deny --version >/dev/null 2>&1 || { \
		echo "Installing cargo-deny $(CARGO_DENY_VERSION), which takes some minutes"; \
		cargo install --locked --version $(CARGO_DENY_VERSION) cargo-deny; \
	}

python-test interrupts-test wheel python-acceptance bench-python: export PERTURB_SERVER := $(abspath $(PROGRAMS))/perturb-server

python-test: $(VENV)/installed opengl ## lint, type-check and test the Python package
	cd python && $(abspath $(VENV))/bin/ruff check . && $(abspath $(VENV))/bin/ruff format --check .
	$(VENV)/bin/ruff check --config python/pyproject.toml benches/peers docker/grafana docker/kubernetes
	$(VENV)/bin/ruff format --check --config python/pyproject.toml benches/peers docker/grafana docker/kubernetes
	cd python && $(abspath $(VENV))/bin/mypy
	cd python && $(abspath $(VENV))/bin/pytest -q

interrupts-test: $(VENV)/installed ## interrupt steps of the Python package by a thousand Ctrl-C; under a minute
	cd python && PERTURB_TEST_INTERRUPTS=$(INTERRUPTS) $(abspath $(VENV))/bin/pytest -q -rP -o faulthandler_timeout=1200 \
		tests/test_interrupts.py

wheel: build $(VENV)/installed ## build the Python package's wheel, with both programs and MuJoCo inside, in python/dist
	rm -rf python/dist $(TARGET)/wheel
	$(VENV)/bin/pip wheel -q --disable-pip-version-check --no-deps --wheel-dir $(TARGET)/wheel ./python
	PATH="$(abspath $(VENV))/bin:$$PATH" $(VENV)/bin/python python/bundle.py $(TARGET)/wheel/*.whl $(PROGRAMS) python/dist

# Where there is no Docker, or no base image, in a new environment on this machine. The container has Python 3.11, and no network.
wheel-test: wheel ## install the wheel in a bare container, and run the programs and the README's loop there
	rm -rf $(TARGET)/wheel-dependencies
	download="$(VENV)/bin/pip download -q --disable-pip-version-check --dest $(TARGET)/wheel-dependencies"; \
	if docker info >/dev/null 2>&1 && $(MAKE) docker-base; then \
		$$download --only-binary :all: --python-version 3.11 --platform manylinux_2_28_x86_64 \
			--platform manylinux_2_17_x86_64 gymnasium numpy && \
		docker build --quiet --file docker/wheel-test.Dockerfile --tag perturb-wheel-test docker && \
		docker run --rm --network none --env BARE=1 --volume $(CURDIR)/python:/python:ro \
			--volume $(abspath $(TARGET))/wheel-dependencies:/dependencies:ro \
			perturb-wheel-test sh -c '/python/tests/wheel_test.sh /python/dist/*.whl /dependencies'; \
	else \
		echo "Without Docker's images the wheel is tested in an environment on this machine"; \
		$$download gymnasium numpy && python/tests/wheel_test.sh python/dist/*.whl $(TARGET)/wheel-dependencies; \
	fi

python-acceptance: $(VENV)/installed ## train with stable-baselines3; gigabytes, minutes
	$(VENV)/bin/pip install -q --disable-pip-version-check -r python/requirements-acceptance.txt
	cd python && $(abspath $(VENV))/bin/pytest -q -m slow

bench-python: $(VENV)/installed ## measure the Python package beside EnvPool, in one run; some two minutes
	$(VENV)/bin/pip install -q --disable-pip-version-check -r python/requirements-bench.txt
	$(VENV)/bin/python -W ignore python/benchmarks/throughput.py $(BENCH_PYTHON_ARGS)

docs: build opengl $(DOCS)/installed ## build the site in target/docs/site; a link to nowhere fails
	@$(call install,$(FFMPEG))
	$(DOCS)/venv/bin/python docs/site/build.py $(PROGRAMS) $(DOCS)

docs-test: docs $(VENV)/installed ## run README's and the tutorials' blocks, follow all links, look at the site in Chromium; minutes
	@$(call install,chromium)
	failed=; \
	$(VENV)/bin/ruff check --config python/pyproject.toml --extend-ignore ANN,D101,D102,D103 docs/site && \
	$(VENV)/bin/ruff format --check --config python/pyproject.toml docs/site || failed="$$failed ruff"; \
	$(VENV)/bin/python docs/site/run_blocks.py $(PROGRAMS) || failed="$$failed blocks"; \
	python3 docs/site/links.py $(DOCS)/site || failed="$$failed links"; \
	python3 docs/site/look.py chromium $(DOCS)/site $(DOCS)/pictures || failed="$$failed look"; \
	[ -z "$$failed" ] || { echo "docs-test failed:$$failed" >&2; exit 1; }

results-check: build $(VENV)/installed ## compute the numbers of README.md, results/ and docs/findings from the results table, and run their commands
	$(VENV)/bin/python docs/site/results_check.py $(PROGRAMS)

$(PROGRAMS)/perturb-server: build ;

# The native module is compiled when the package is installed, and the server is asked for its catalogue.
$(VENV)/installed: python/requirements-dev.txt python/pyproject.toml python/build_backend.py proto/perturb/v1/perturb.proto \
		$(wildcard python/native/Cargo.toml python/native/src/*.rs python/native/src/*/*.rs crates/*/src/*.rs crates/*/src/*/*.rs crates/*/src/*/*/*.rs) Cargo.lock \
		$(PROGRAMS)/perturb-server | python-venv
	python3 -m venv $(VENV)
	$(VENV)/bin/pip install -q --disable-pip-version-check -r python/requirements-dev.txt
	$(VENV)/bin/pip install -q --disable-pip-version-check --no-deps --editable python
	touch $@

$(DOCS)/installed: docs/site/requirements.txt | python-venv
	python3 -m venv $(DOCS)/venv
	$(DOCS)/venv/bin/pip install -q --disable-pip-version-check -r $<
	touch $@

$(DM_ENV_RPC)/installed: tests/server/dm_env_rpc/requirements.txt | python-venv
	python3 -m venv $(DM_ENV_RPC)
	$(DM_ENV_RPC)/bin/pip install -q --disable-pip-version-check -r $<
	touch $@

# Its dependencies are not needed: its models are files.
$(GYMNASIUM)/installed: tests/server/folder/requirements.txt | python-venv
	python3 -m venv $(GYMNASIUM)/venv
	$(GYMNASIUM)/venv/bin/pip install -q --disable-pip-version-check --no-deps --upgrade --target $(GYMNASIUM) -r $<
	touch $@

$(KUBERNETES)/installed: docker/kubernetes/requirements.txt | python-venv
	python3 -m venv $(KUBERNETES)
	$(KUBERNETES)/bin/pip install -q --disable-pip-version-check -r $<
	touch $@

$(BUF)/installed: proto/requirements.txt | python-venv
	python3 -m venv $(BUF)
	$(BUF)/bin/pip install -q --disable-pip-version-check -r $<
	touch $@

$(PEERS)/installed: benches/peers/requirements.txt | python-venv
	python3 -m venv $(PEERS)
	$(PEERS)/bin/pip install -q --disable-pip-version-check -r $<
	[ -d $(PEERS)/purejaxrl ] || git clone -q $(PUREJAXRL) $(PEERS)/purejaxrl
	git -C $(PEERS)/purejaxrl checkout -q $(PUREJAXRL_COMMIT)
	touch $@

# Debian keeps what fills a new environment in a package of its own.
python-venv:
	@command -v python3 >/dev/null && python3 -c 'import ensurepip' 2>/dev/null || { $(call install,python3 python3-venv); }

# The commit as the build script writes it: the repository is no part of the images' context.
docker: docker-base ## build the container images perturb-server and perturb-learner
	for program in server learner; do \
		docker build $(DOCKER_ARGS) --file docker/$$program.Dockerfile --tag perturb-$$program \
			--build-arg PERTURB_COMMIT="$$(git describe --always --abbrev=12 --dirty --exclude='*' 2>/dev/null || echo unknown commit)" . \
			|| exit 1; \
	done

docker-base:
	@command -v docker >/dev/null || { echo "docker is missing; install Docker 20.10 or later, on Debian the package docker.io" >&2; exit 1; }
	@docker info >/dev/null 2>&1 || { \
		echo "Docker does not answer: start its service, or have yourself added to the group docker" >&2; exit 1; \
	}
	@for image in $(BASE_IMAGES); do \
		docker image inspect $$image >/dev/null 2>&1 || docker pull --quiet $$image || { \
			echo "The base image $$image is missing and cannot be pulled; docker/README.md says how else to come by it" >&2; exit 1; \
		}; \
	done

# How often `make faults-test` tries and `make interrupts-test` interrupts, how long `make load-test` steps, and
# how many lines `make simulation-test` simulates for each test.
FAULTS_ROUNDS ?= 5
INTERRUPTS ?= 1000
LOAD_SECONDS ?= 300
SIMULATIONS ?= 50

# A tokio whose clock can be stopped is not what programs have, so that all that stands on it is compiled for this alone.
simulation-test: deps ## sessions and their leases in simulated time, over a line that is cut at random; minutes to compile
	PERTURB_SIMULATIONS=$(SIMULATIONS) cargo test --release --locked --package perturb-simulation --features turmoil -- --nocapture

# AddressSanitizer needs a nightly compiler. What the compiler of C makes of the shim is not looked into, but every
# allocation of MuJoCo's is. Debian's OpenGL in software keeps what it allocated for a thread that draws.
asan-test: deps opengl ## run crates/mujoco's tests under AddressSanitizer; nightly Rust
	@cargo +nightly --version >/dev/null || { echo "a nightly toolchain is missing: rustup toolchain install nightly" >&2; exit 1; }
	RUSTFLAGS=-Zsanitizer=address RUSTDOCFLAGS=-Zsanitizer=address LSAN_OPTIONS=suppressions=$(abspath fuzz/leaks.txt) \
		cargo +nightly test --package perturb-mujoco --locked --target $$(rustc -vV | sed -n 's/^host: //p') --target-dir $(TARGET)/asan

# Seconds for each of ten targets, and what is mutated from one time to the next. Inputs are short, for speed, but for
# recorded episodes, whose seed is a whole file.
FUZZ_SECONDS ?= 38
FUZZ = $(TARGET)/fuzz-corpus
FUZZ_RUN = LSAN_OPTIONS=suppressions=$(abspath fuzz/leaks.txt) cargo +nightly fuzz run --fuzz-dir fuzz \
	--target-dir $(TARGET)/fuzz --features libfuzzer
FUZZ_BOUNDS = -timeout=60 -rss_limit_mb=4096
FUZZ_TARGETS = requests snapshots worlds connections checkpoints records plans ledgers tasks models
fuzz: deps ## attack the server and the readers of files with mutated bytes, under AddressSanitizer; five minutes, nightly Rust
	@cargo +nightly --version >/dev/null || { echo "a nightly toolchain is missing: rustup toolchain install nightly" >&2; exit 1; }
	@cargo +nightly fuzz --version >/dev/null 2>&1 || cargo +nightly install cargo-fuzz --locked
	cargo run --release --locked --manifest-path fuzz/Cargo.toml --target-dir $(TARGET)/fuzz --bin seeds -- $(FUZZ)
	@set -e; for target in $(FUZZ_TARGETS); do \
		mkdir -p fuzz/corpus/$$target; \
		case $$target in records) longest=200000;; *) longest=65536;; esac; \
		$(FUZZ_RUN) $$target $(FUZZ)/$$target fuzz/corpus/$$target -- \
			-max_total_time=$(FUZZ_SECONDS) $(FUZZ_BOUNDS) -max_len=$$longest -print_final_stats=1; \
	done

fuzz-keep: ## keep, of what fuzz found that clients may send, as few inputs in fuzz/corpus as cover what those there do not
	@set -e; for target in requests snapshots worlds connections; do \
		$(FUZZ_RUN) $$target fuzz/corpus/$$target $(FUZZ)/$$target -- \
			-set_cover_merge=1 $(FUZZ_BOUNDS) -max_len=4096; \
	done

attack-test: export PERTURB_FUZZ_MOST_GROWN_MB = 20
attack-test: all-deps ## a million mutated requests and a hundred thousand snapshots, which may take no memory along; minutes
	PERTURB_FUZZ_INPUTS=1000000 cargo test $(ALL) --package perturb-fuzz --test corpus -- --nocapture --exact requests
	PERTURB_FUZZ_INPUTS=100000 cargo test $(ALL) --package perturb-fuzz --test corpus -- --nocapture --exact snapshots

docker-test: docker ## run experiments on servers and learners in containers, stop a server in mid-run, and let nobody in who may not
	docker/test.sh
	docker/test_guarded.sh
