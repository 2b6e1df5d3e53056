# `make demo` and `make test` do everything on a fresh Debian 12 machine with git, make and a Rust toolchain.

PACKAGES := build-essential ca-certificates clang cmake gstreamer1.0-plugins-base libopencv-dev pkg-config
SUDO := $(shell [ "$$(id -u)" = 0 ] || echo sudo)
SECONDS_PER_SCENE ?= 15
BUILD := $(or $(CARGO_TARGET_DIR),target)
# PROFILE=dev measures with the programs of `make test`, which are there sooner.
PROFILE ?= release
PROGRAMS := $(BUILD)/$(if $(filter dev,$(PROFILE)),debug,$(PROFILE))
RELEASE := $(if $(filter release,$(PROFILE)),--release)
SETS ?= examples/crowd_labels
VERDICTS ?= 200
PASSES ?= 50

comma := ,

.PHONY: help help-all check words changelog setup demo demo-picture testbed compare results-check tables-check eval-labels compare-labels eval-generated eval-tracks eval-city eval-tracks-check eval-real liars test test-dashboard monitoring sim sim-check trials trials-and-attacks joining clocks renewal soak attack lint other-features doc audit bench core-only fuzz instructions rooms snapshots code-lines replay-check replay-check-arm64 edge-only recording-check models-check live-check foxglove-check tracing-check verify-handshake asyncapi-check python-client-check cpm-check ros2-check dds-check deb deb-arm64 package-check package-check-arm64 footprint release release-check instructions-arm64 city clean

# A target that `make help` lists has its group in square brackets.
help:
	@awk -F ':.*## ' 'BEGIN { n = split("start check measure release", groups, " ") } \
	    match($$2, /^\[[a-z]+\] /) { group = substr($$2, 2, RLENGTH - 3); text[group] = text[group] sprintf("  %-12s %s\n", $$1, substr($$2, RLENGTH + 1)) } \
	    END { for (i = 1; i <= n; i++) printf "%s\n%s", groups[i], text[groups[i]] }' $(MAKEFILE_LIST)

help-all: ## [start] list all targets
	@awk -F ':.*## ' '/^[a-z0-9-]+:.*## / { sub(/^\[[a-z]+\] /, "", $$2); printf "%-24s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

check: ## [check] format, clippy and unit tests of the core and of the node without OpenCV, as on each push
	cargo fmt --all --check
	cargo clippy --locked -p ecod --lib --tests -- -D warnings
	cargo clippy --locked -p ecod-actors --no-default-features --lib --bins -- -D warnings
	cargo test --locked --quiet -p ecod --lib
	cargo test --locked --quiet -p ecod-actors --no-default-features --lib --bins

words: PACKAGES := python3
words: setup ## [check] three habits that make texts hard to read, per area; the numbers may only fall
	packaging/check-words

# make changelog VERSION=0.2.0 writes the section and removes the fragments.
changelog: PACKAGES := python3
changelog: setup ## [release] join the fragments of changes/ into a section of CHANGELOG.md
	packaging/join-changes $(VERSION)

setup: ## [start] install the system packages that are missing
	@missing=$$(for p in $(PACKAGES); do dpkg-query -W -f='$${Status}' $$p 2>/dev/null | grep -q 'ok installed' || echo $$p; done); \
	if [ -n "$$missing" ]; then \
	    echo "installing" $$missing; \
	    $(SUDO) apt-get update -qq && \
	    DEBIAN_FRONTEND=noninteractive $(SUDO) apt-get install -y -qq --no-install-recommends $$missing >/dev/null; \
	fi

demo: setup ## [start] run a whole cell as separate processes on this machine and print its accuracy
	cargo build --release --locked --bin ecod-node --bin ecod-video --bin ecod-lab
	$(BUILD)/release/ecod-lab demo --seconds $(SECONDS_PER_SCENE) --output target/demo

demo-picture: PACKAGES += chromium chromium-driver python3-venv
demo-picture: setup ## the recording in README.md: the live page while the edge of the demo's street is killed; installs Chromium
	cargo build --profile $(PROFILE) --locked --bin ecod-node --bin ecod-video --bin ecod-lab
	packaging/page-recording $(PROGRAMS) docs/page.webp

testbed: setup ## accuracy on the recorded parking lots, rendered and detected, and on the recorded intersection; the table goes into docs/results.md
	cargo build --profile $(PROFILE) --locked --bin ecod-lab --example testbed_table
	for setup in 1 2; do $(PROGRAMS)/ecod-lab testbed --scenes examples/testbed/pace_setup$$setup.json --verdicts $(VERDICTS) \
	    --at-least 99.5 --occupied-at-least 99 --output target/testbed-setup$$setup.json || exit; done
	$(PROGRAMS)/ecod-lab testbed --scenes examples/testbed/vote_recording.json --at-least 100 --output target/testbed-vote.json
	$(PROGRAMS)/examples/testbed_table "parking lots, setup 1=target/testbed-setup1.json" "parking lots, setup 2=target/testbed-setup2.json" \
	    intersection=target/testbed-vote.json $(if $(filter 200,$(VERDICTS)),--write-table docs/results.md)

# SETS=DIR runs other label sets: DIR/<set>/label.csv (item,worker,label and perhaps confidence) and truth.csv (item,truth).
# OPTIONS="--seconds 20" takes other options of packaging/compare.
compare: PACKAGES += binutils mosquitto python3-venv
compare: setup ## [measure] ECOD beside the paper's way in Python: latency, costs, gap, accuracy; writes the table in docs/results.md
	packaging/compare $(or $(OPTIONS),--write-table docs/results.md)

eval-labels: setup ## accuracy of VOTE on label sets; the tables go into docs/results.md
	cargo build --profile $(PROFILE) --locked --bin ecod-node --bin ecod-lab
	cargo run --quiet --locked --example eval_labels -- --program $(PROGRAMS)/ecod-node --sets "$(SETS)" --passes $(PASSES) \
	    --work $(BUILD)/eval-labels $(if $(filter examples/crowd_labels,$(SETS)),--write-table docs/results.md)

results-check: eval-labels ## fails if the tables of label sets in docs/results.md differ from the measured ones
	git diff --exit-code docs/results.md

tables-check: eval-labels eval-tracks eval-city liars testbed ## measure all tables and drawings of docs/ that do not depend on the machine; fails if one changes
	git diff --exit-code docs

compare-labels: PACKAGES += python3-venv
compare-labels: setup ## VOTE beside the methods of crowd-kit, from PyPI, on label sets; SETS=DIR
	packaging/compare-labels "$(SETS)"

eval-generated: setup ## VOTE beside the majority on 200 generated label sets
	cargo test --release --locked -p ecod --test core vote::generated:: -- --include-ignored --nocapture

eval-tracks: setup ## [measure] tracking in generated traffic beside single vehicles and late fusion; writes table and drawings in docs/
	cargo run --profile $(PROFILE) --quiet --locked --example eval_tracks -- --seeds $(or $(TRAFFIC),report) \
	    $(if $(filter tuning,$(TRAFFIC)),,--write-table docs/results.md --svg docs/tracks.svg --reliability docs/reliability.svg)

# DIR holds copies of the repositories that docs/evaluation.md names; the program names missing ones.
eval-real: setup ## accuracy on real recordings and label sets in DIR=...: KITTI, WILDTRACK, CF, SP; the table goes into docs/results.md
	@test -n "$(DIR)" || { echo "make eval-real DIR=... : a directory with the data that docs/evaluation.md names"; exit 2; }
	cargo build --profile $(PROFILE) --locked --bin ecod-node --bin ecod-lab
	@status=0; \
	cargo run --quiet --locked --example eval_real -- --program $(PROGRAMS)/ecod-node --data "$(DIR)" --work $(BUILD)/eval-real \
	    --write-table docs/results.md || status=1; \
	for set in CF CF_amt SP SP_amt; do \
	    cargo run --quiet --locked --example eval_labels -- --program $(PROGRAMS)/ecod-node \
	        --sets "$(DIR)/truth-inference-at-scale/data/active-crowd-toolkit/$$set" --work $(BUILD)/eval-real/labels || status=1; \
	done; exit $$status

eval-city: setup ## nine cells in generated traffic beside one aggregator over everything; the table goes into docs/results.md
	cargo run --profile $(PROFILE) --quiet --locked --example eval_city -- --write-table docs/results.md

eval-tracks-check: PACKAGES += python3-venv
eval-tracks-check: setup ## figures of tracks against TrackEval and motmetrics from PyPI
	packaging/check-eval-tracks

# All programs are built before the first test: those of ecod-lab need ecod-node beside it.
# Only the tests' own brokers are wanted; a service of that name would hold the port of a node.
# Most tests wait most of their time. TEST_FLAGS=--no-run only builds them.
# nextest (.config/nextest.toml) takes little more than half of the time, because it runs tests of several programs at once.
test: export RUST_TEST_THREADS ?= $(shell expr 2 '*' $$(nproc))
test: PACKAGES += libfaketime mosquitto mosquitto-clients nats-server
test: setup ## [check] all tests
ifeq ($(shell cargo nextest --version >/dev/null 2>&1 && echo nextest),nextest)
	cargo nextest run --locked --test-threads $$((4 * $$(nproc))) $(TEST_FLAGS)
	$(if $(findstring --no-run,$(TEST_FLAGS)),,cargo test --locked --doc)
else
	cargo test --locked $(TEST_FLAGS)
endif

test-dashboard: PACKAGES += chromium chromium-driver
test-dashboard: setup monitoring ## the page in a real browser, with pictures in target/dashboard; installs Chromium
	cargo test --locked --test dashboard -- --ignored --nocapture

monitoring: ## check the rules for Prometheus; takes promtool out of Debian's package if it is not installed
	packaging/check-monitoring

sim: setup ## [check] simulated cells under faults: SEEDS=10000, or one with SEED=n
	SEEDS=$${SEEDS:-10000} cargo test --release --locked -p ecod --test election sim:: -- --nocapture

sim-check: setup ## bugs put in by hand, each of which the simulated cells must find within SEEDS=1000 seeds
	packaging/check-sim

trials: PACKAGES += iproute2 mosquitto mosquitto-clients nftables
trials: setup ## [measure] gaps of real cells that are killed, stopped and cut off: TRIALS=20 SCENARIOS=a,b NODES=2,5
	cargo test $(RELEASE) --locked --test trials -- --ignored --exact failover::trials --nocapture

joining: PACKAGES += iproute2 mosquitto-clients
joining: setup ## three machines, in network namespaces, become a cell by the commands of the README
	cargo test --locked --test trials -- --ignored --exact joining::machines::readme_commands_form_cell

clocks: PACKAGES += libfaketime
clocks: setup ## real cells with wrong clocks that step, as vehicle and as leader; TRIAL=NAME runs those with it in their name
	cargo test --release --locked --test trials -- --ignored --exact clocks::all --nocapture

renewal: PACKAGES += libfaketime
renewal: setup ## cells of real nodes whose certificates are renewed twice, in six minutes and in a simulated year: missed maps
	cargo test $(RELEASE) --locked --test trials -- --ignored --exact renewal::every_node_is_renewed_twice \
	    renewal::year_passes_without_missed_map --nocapture --test-threads 1

# For .ci/run. Both take the variables of their own targets.
trials-and-attacks: PACKAGES += iproute2 mosquitto mosquitto-clients nftables
trials-and-attacks: setup ## make trials and make attack by one program
	cargo test $(RELEASE) --locked --test trials -- --ignored --exact failover::trials attacks::attacks --nocapture --test-threads 1

soak: PACKAGES += iproute2 nftables
soak: setup ## [measure] a cell of NODES=32 under seeded faults for MINUTES=30, SEED=1
	cargo test $(RELEASE) --locked --test trials -- --ignored --exact failover::soak::soak --nocapture

attack: PACKAGES += iproute2
attack: setup ## [measure] attackers of all kinds against real cells: ROWS=text selects rows, ATTACK=quick a part
	cargo test $(RELEASE) --locked --test trials -- --ignored --exact attacks::attacks --nocapture

lint: setup ## [check] formatting, clippy and rustdoc with warnings denied
	cargo fmt --all --check
	cargo clippy --locked --workspace --exclude ecod-fuzz --all-targets --features ecod-actors/otel,ecod-instructions/detectors -- -D warnings
	RUSTDOCFLAGS="-D warnings" cargo doc --locked --no-deps --document-private-items

doc: setup ## API documentation in target/doc
	cargo doc --locked --no-deps

other-features: setup ## compile the node with other sets of features, and the fuzz targets
	cargo check --locked -p ecod-actors --no-default-features --features foxglove,otel --bins --test programs
	cargo check --locked -p ecod-actors --no-default-features --features camera --lib
	RUSTC_WORKSPACE_WRAPPER=$(CURDIR)/fuzz/rustc-with-coverage cargo check --locked -p ecod-fuzz

audit: ## [check] licences, sources, duplicates and known vulnerabilities of all dependencies
	packaging/audit

snapshots: ## messages, their schemas, help, error texts, remedies and tables of keys against their snapshots; INSTA_UPDATE=always writes these anew
	cargo test --locked --quiet --test core -- messages:: troubles::
	cargo test --locked --quiet -p ecod-actors -p ecod-lab --test programs -- help:: errors:: configuration_reference:: schema::
	cargo test --locked --quiet -p ecod-region --test engine -- help:: errors::
	cargo test --locked --quiet -p ecod-interop --test bridges -- help:: errors::

core-only: ## prove that the core needs no runtime: it depends on a list of crates, none of them tokio, sockets or OpenCV
	packaging/check-core

rooms: ## print the modules of each crate by floor, and prove that imports run downward without a circle
	cargo test --quiet --locked --test core rooms:: -- --nocapture

code-lines: ## count the lines of code of each room, without tests and comments
	packaging/code-lines

replay-check: ## prove that replays of a release build have the bytes that the tests of the debug build demand
	cargo test --locked --release -p ecod --test core replays::

replay-check-arm64: export CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER = aarch64-linux-gnu-gcc
replay-check-arm64: export CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_RUNNER = qemu-aarch64-static -L /usr/aarch64-linux-gnu
replay-check-arm64: PACKAGES := build-essential ca-certificates gcc-aarch64-linux-gnu libc6-dev-arm64-cross qemu-user-static
replay-check-arm64: setup ## prove the same of the core built for arm64, under qemu; needs the Rust target aarch64-unknown-linux-gnu
	cargo test --locked --target aarch64-unknown-linux-gnu -p ecod --test core replays::

recording-check: PACKAGES += python3-venv
recording-check: setup ## prove that the Python reader of MCAP reads what nodes record; installs it in a directory of its own
	python3 -m venv $(BUILD)/recording-venv
	$(BUILD)/recording-venv/bin/pip install --quiet mcap
	MCAP_PYTHON=$(abspath $(BUILD))/recording-venv/bin/python3 cargo test --locked --test programs -- --include-ignored --nocapture recording::python

live-check: setup ## record with the feature foxglove, and look on as Foxglove does
	cargo test --locked -p ecod-actors --no-default-features --features foxglove --test programs recording::

foxglove-check: PACKAGES += $(if $(shell command -v npm),,npm)
foxglove-check: setup ## a camera's log against Foxglove's published schemas, and the layout against the log; installs npm where there is none
	packaging/check-foxglove

tracing-check: setup ## follow a detection through two nodes, with the feature otel
	cargo test --locked -p ecod-actors --features otel --test programs spans::

fuzz: setup ## [check] hostile input for decoders, evidence and fuser: SECONDS=60 or RUNS=n per target, TARGETS=payload,...
	packaging/fuzz $(or $(SECONDS),60) $(subst $(comma), ,$(TARGETS))

verify-handshake: ## the membership's handshake against an attacker that has the network, the cell's key and a certificate; needs Verifpal
	packaging/verify-handshake

asyncapi-check: PACKAGES := ca-certificates $(if $(shell command -v npm),,npm)
asyncapi-check: setup ## validate docs/asyncapi.yaml by the parser of its standard; installs npm where there is none
	packaging/check-asyncapi

models-check: PACKAGES += python3-venv
models-check: setup ## the boxes that the detector's tests expect, found once more by ONNX Runtime and Python; YOLOX=FILE also tries photographs
	python3 -m venv $(BUILD)/models-venv
	$(BUILD)/models-venv/bin/pip install --quiet numpy onnx onnxruntime $(if $(YOLOX),opencv-python-headless)
	$(BUILD)/models-venv/bin/python3 actors/tests/data/onnx/make.py --check
ifdef YOLOX
	$(BUILD)/models-venv/bin/python3 actors/tests/data/onnx/photos.py $(YOLOX) > $(BUILD)/yolox-photos.json
	YOLOX_MODEL=$(abspath $(YOLOX)) YOLOX_PHOTOS=$(abspath $(BUILD)/yolox-photos.json) \
	    cargo test --locked -p ecod-actors --lib yolox_matches_onnx_runtime -- --ignored --nocapture
else
	@echo "no photographs were tried: YOLOX=FILE names an export of YOLOX without --decode_in_inference, such as yolox_nano.onnx"
endif

# PYTHONS="python3.9 python3.13" tests it with these.
python-client-check: PACKAGES += mosquitto python3-venv
python-client-check: setup ## the Python client: built, installed in clean environments, its types and tests at real brokers and nodes
	cargo build --locked --bin ecod-node
	packaging/check-python-client $(PYTHONS)

# ASN1=DIR takes another copy of ETSI's modules, such as vanetza/asn1/release2.
cpm-check: PACKAGES := build-essential ca-certificates python3-venv
cpm-check: setup ## messages of ecod-interop, read by asn1tools with ETSI's ASN.1 and written again to the same bytes
	packaging/check-cpm

ros2-check: PACKAGES := build-essential ca-certificates python3-venv
ros2-check: setup ## a node's log for ROS 2, read by mcap-ros2-support and written again to the same bytes by rosbags
	python3 -m venv $(BUILD)/ros2-venv
	$(BUILD)/ros2-venv/bin/pip install --quiet mcap-ros2-support rosbags
	ROS2_PYTHON=$(abspath $(BUILD))/ros2-venv/bin/python3 cargo test --locked --test bridges ros2:: -- --include-ignored --nocapture

dds-check: PACKAGES := build-essential ca-certificates iproute2 python3-venv
dds-check: setup ## live topics of ROS 2 and a detector's, in a network of their own, against Cyclone DDS for Python; needs root
	packaging/check-dds

deb: setup ## [release] Debian packages with camera, without camera, and of the COCO weights, in target/debian
	packaging/deb

deb-arm64: PACKAGES += debootstrap systemd-container
deb-arm64: setup ## these packages for arm64, built in a Debian in target/arm64-root; needs root
	packaging/arm64 packaging/deb

package-check-arm64: PACKAGES += mosquitto-clients python3 qrencode
package-check-arm64: deb-arm64 ## install the arm64 packages in that Debian, and hold their program, under qemu, against the amd64 one
	cargo build --release --locked --bin ecod-node
	packaging/check-arm64 $(BUILD)/release/ecod-node

package-check: PACKAGES += debootstrap systemd-container
package-check: setup ## build the package without camera, and install, run, upgrade and remove it in a Debian of its own; needs root
	packaging/check-package

footprint: PACKAGES += python3
footprint: deb ## [measure] size, memory and start time of the packaged node against bars
	packaging/check-footprint

release: PACKAGES += apt-utils debootstrap gnupg systemd-container
release: setup ## [release] packages for amd64 and arm64, SBOM, checksums and an apt repository of the commit, in target/dist; KEY=... signs it
	packaging/release

release-check: PACKAGES += debootstrap gnupg
release-check: setup ## after make release: prove that a clean clone elsewhere gives the same packages (CLONED="ecod-node-edge" only that), and that apt installs target/dist
	packaging/check-release $(CLONED)
	packaging/check-repository

edge-only: setup ## an aggregator without camera and OpenCV
	cargo build --locked -p ecod-actors --no-default-features

# CITY=quick is a minute; CITY="--cells 500" takes other options of the program.
city: PACKAGES += nats-server
city: setup ## a region of three servers with 2000 simulated cells and 20 real ones: killed, stopped, cut off, restarted
	cargo build --profile $(PROFILE) --locked --bin ecod-node --bin ecod-region --example city
	REGION_PROGRAM=$(PROGRAMS)/ecod-region $(PROGRAMS)/examples/city --node $(PROGRAMS)/ecod-node \
	    $(if $(filter quick,$(CITY)),--quick --cells 200 --real 2 --seconds 6,--real 20 $(CITY))

bench: setup ## [measure] speed of core, detectors and broker path, in target/bench.json
	packaging/bench

instructions: PACKAGES := build-essential ca-certificates valgrind
instructions: setup ## instructions of the core's hot paths against the baseline; SAVE=1 writes a new one
	packaging/instructions $(if $(SAVE),--save)

instructions-arm64: PACKAGES += debootstrap python3 systemd-container valgrind
instructions-arm64: setup ## instructions of core and detectors on arm64 beside amd64, and the time that Pis take by them; needs root
	cargo build --release --locked -p ecod-instructions --features detectors --bin ecod-work
	packaging/arm64 cargo build --release --locked --target aarch64-unknown-linux-gnu -p ecod-instructions --features detectors --bin ecod-work
	packaging/count-arm64 $(BUILD)/release/ecod-work target/arm64/aarch64-unknown-linux-gnu/release/ecod-work

liars: setup ## what lying vehicles achieve against VOTE, within a bound: table in docs/results.md, drawing in target/liars.svg; SEEDS=n only checks
	mkdir -p target
	cargo run --profile $(PROFILE) --locked --example liars -- $(if $(SEEDS),--seeds $(SEEDS),--write-table docs/results.md --svg target/liars.svg)

clean: ## remove everything that was built
	cargo clean
