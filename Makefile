# The commands of the README. Everything is built in one profile: programs, tests and measurements run the same code.

CARGO ?= cargo

.PHONY: run test soak stability setup setup-test format clippy docs bench fuzz test-slurm

# NODEVICE_SELECT keeps a layer of Mesa from complaining about the session that a headless machine does not have.

# The wall, on the built-in model with two local render servers; without a display the same, to wall.png.
run: setup
	$(CARGO) build --release
	@if [ -n "$$DISPLAY$$WAYLAND_DISPLAY" ]; then \
		$(CARGO) run --release; \
	else \
		NODEVICE_SELECT=1 $(CARGO) run --release -- --headless --frames 20 --target-rate 30 --samples 4 --screenshot wall.png; \
	fi

# Everything that CI checks. The programs are built first: the tests run them as a person would.
test: setup-test format clippy docs
	$(CARGO) build --release --workspace --bins
	$(CARGO) test --release --workspace

# Ten minutes of render servers that join, freeze, wake and die at random; twenty seconds of it are in the tests.
soak: setup-test
	$(CARGO) build --release
	RAYWALL_CHURN_SECONDS=600 $(CARGO) test --release -p tests --test wall -- churn --nocapture

# Every way to intersect rays with triangles, where it fails: ten million rays a case; a hundredth of them is in the tests.
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

# How fast the grid is built and followed, on generated models: a minute or two.
bench:
	$(CARGO) bench -p lab --bench grid

# Every decoder on invented inputs, FUZZ_RUNS each (of the slow one, records, a fiftieth); what is found lies in
# target/fuzz-found, and new inputs worth keeping in target/fuzz-corpus. RUSTC_BOOTSTRAP lets a stable compiler sanitize.
FUZZ_RUNS ?= 2500000
FUZZ_TARGETS ?= camera placement ply protocol records wall
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

# A real Slurm on this machine starts render servers; as root, for it installs and runs Slurm's daemons.
test-slurm:
	$(CARGO) build --release
	@sh tests/slurm.sh

# What the system lacks, shown in one line and installed if you agree. YES=1 and CI do not ask.
setup:
	@sh tests/setup.sh run

setup-test:
	@sh tests/setup.sh test
