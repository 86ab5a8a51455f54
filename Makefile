# The commands of the README. Everything is built in one profile: programs, tests and measurements run the same code.

CARGO ?= cargo

.PHONY: run test soak setup setup-test format clippy docs bench test-slurm

# NODEVICE_SELECT keeps a layer of Mesa from complaining about the session that a headless machine does not have.

# The wall, on the built-in model with two local render servers; without a display the same, to wall.png.
run: setup
	$(CARGO) build --release
	@if [ -n "$$DISPLAY$$WAYLAND_DISPLAY" ]; then \
		$(CARGO) run --release; \
	else \
		NODEVICE_SELECT=1 $(CARGO) run --release -- --headless --frames 20 --screenshot wall.png; \
	fi

# Everything that CI checks. The programs are built first: the tests run them as a person would.
test: setup-test format clippy docs
	$(CARGO) build --release
	$(CARGO) test --release --workspace

# Ten minutes of render servers that join, freeze, wake and die at random; twenty seconds of it are in the tests.
soak: setup-test
	$(CARGO) build --release
	RAYWALL_CHURN_SECONDS=600 $(CARGO) test --release -p tests --test wall -- churn --nocapture

format:
	$(CARGO) fmt --all --check

clippy:
	$(CARGO) clippy --release --workspace --all-targets -- -D warnings

docs:
	RUSTDOCFLAGS="-D warnings" $(CARGO) doc --release --workspace --no-deps --document-private-items

# How fast the grid is built and followed, on generated models: a minute or two.
bench:
	$(CARGO) bench -p renderer --bench grid

# A real Slurm on this machine starts render servers; as root, for it installs and runs Slurm's daemons.
test-slurm:
	$(CARGO) build --release
	@sh tests/slurm.sh

# What the system lacks, shown in one line and installed if you agree. YES=1 and CI do not ask.
setup:
	@sh tests/setup.sh run

setup-test:
	@sh tests/setup.sh test
