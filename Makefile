# The commands of the README. One profile builds everything: programs, tests and measurements run the same code.

CARGO ?= cargo

.PHONY: run test soak stability setup setup-test format clippy docs bench large mitsuba fuzz test-slurm

# The wall, with the built-in model and two local render servers; without a display it goes to wall.png.
run: setup
	$(CARGO) build --release
	@if [ -n "$$DISPLAY$$WAYLAND_DISPLAY" ]; then \
		$(CARGO) run --release; \
	else \
		$(CARGO) run --release -- --headless --frames 20 --target-rate 30 --samples 16 --screenshot wall.png; \
	fi

# Everything that CI checks. The tests start the programs, so they are built first.
test: setup-test format clippy docs
	$(CARGO) build --release --workspace --bins
	$(CARGO) test --release --workspace

# Ten minutes of render servers that join, freeze, wake and die at random, with lying nodes, floods and the deaths of most
# of 512 nodes beside it; `make test` runs twenty seconds of it, and 64 nodes.
soak: setup-test
	$(CARGO) build --release
	RAYWALL_CHURN_SECONDS=600 $(CARGO) test --release -p tests --test wall -- churn liars losses --nocapture

# Difficult cases for every intersection method, ten million rays each; `make test` runs a hundredth of them.
STABILITY_RAYS ?= 10000000
stability:
	$(CARGO) run --release -p lab -- stability --rays $(STABILITY_RAYS)

format:
	$(CARGO) fmt --all --check

clippy:
	$(CARGO) clippy --release --workspace --all-targets -- -D warnings
	$(CARGO) check --manifest-path tests/fuzz/Cargo.toml --target-dir target/fuzz-check

docs:
	RUSTDOCFLAGS="-D warnings" $(CARGO) doc --release --workspace --no-deps --document-private-items

# Times on one thread: building the grid of the built-in statue, packets, single rays, shadow rays, and rays that share no
# origin.
BENCH_TRIANGLES ?= 1000000
bench:
	@for options in "--kernel packet" "--kernel single" "--shadow-rays" "--secondary-rays"; do \
		echo "== $$options" && \
		$(CARGO) run --release --quiet -p lab -- trace --triangles $(BENCH_TRIANGLES) --threads 1 --frames 20 $$options || exit 1; \
	done

# Very large models: building, starting, frames and memory. It says first what it needs, and ends if this machine lacks that;
# `make test` measures a small one.
LARGE_TRIANGLES ?= 10000000,100000000
LARGE_FLAGS ?=
large:
	$(CARGO) build --release
	$(CARGO) run --release -p lab -- large --triangles $(LARGE_TRIANGLES) $(LARGE_FLAGS)

# Path-traced light beside that of Mitsuba 3, which it installs from PyPI into target/mitsuba.
MODEL ?= target/statue.ply
MITSUBA_OPTIONS ?=
# Mitsuba compiles its kernels with an LLVM, and versions 14 and 15 fail on AVX-512: Rust's own toolchain has a newer one.
DRJIT_LIBLLVM_PATH ?= $(firstword $(wildcard $(shell rustc --print sysroot)/lib/libLLVM.so*))
mitsuba:
	$(CARGO) build --release -p renderer -p lab --bins --examples
	@[ -e $(MODEL) ] || target/release/renderer generate statue --triangles 100000 $(MODEL)
	@[ -e target/mitsuba/bin/mitsuba ] || { python3 -m venv target/mitsuba && target/mitsuba/bin/pip install --quiet mitsuba numpy; }
	$(if $(DRJIT_LIBLLVM_PATH),DRJIT_LIBLLVM_PATH="$(DRJIT_LIBLLVM_PATH)") target/mitsuba/bin/python tests/lab/beside_mitsuba.py $(MODEL) $(MITSUBA_OPTIONS)

# Fuzzes every decoder with FUZZ_RUNS inputs each (a fiftieth for the slow one, records). Findings go to target/fuzz-found,
# new inputs worth keeping to target/fuzz-corpus. RUSTC_BOOTSTRAP allows sanitizers on a stable compiler.
FUZZ_RUNS ?= 2500000
FUZZ_TARGETS ?= $(basename $(notdir $(wildcard tests/fuzz/fuzz_targets/*.rs)))
CARGO_FUZZ = RUSTC_BOOTSTRAP=1 $(CARGO) fuzz run --fuzz-dir tests/fuzz --target-dir target/fuzz
fuzz: setup-test
	@$(CARGO) fuzz --version >/dev/null 2>&1 || $(CARGO) install cargo-fuzz --locked
	@for target in $(FUZZ_TARGETS); do \
		runs=$(FUZZ_RUNS); [ $$target != records ] || runs=$$((runs / 50)); \
		mkdir -p target/fuzz-corpus/$$target target/fuzz-found && \
		$(CARGO_FUZZ) $$target $(CURDIR)/target/fuzz-corpus/$$target $(CURDIR)/tests/corpus/$$target -- -runs=$$runs -max_len=2048 \
			-timeout=10 -rss_limit_mb=2048 -artifact_prefix=$(CURDIR)/target/fuzz-found/$$target- -verbosity=0 || exit 1; \
		echo "$$target: $$runs inputs"; \
	done

# A real Slurm on this machine starts render servers. Needs root, to install and run Slurm's daemons.
test-slurm:
	$(CARGO) build --release
	@sh tests/slurm.sh

# Shows missing system packages in one line, and installs them if you agree. YES=1 and CI skip the question.
setup:
	@sh tests/setup.sh run

setup-test:
	@sh tests/setup.sh test
	@[ -e target/axe/node_modules/axe-core/axe.min.js ] || npm install --prefix target/axe --no-save --silent axe-core@4 || \
		echo "setup: npm cannot fetch axe-core: the test that needs it is skipped"
