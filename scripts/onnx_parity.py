#!/usr/bin/env python3
"""Compares an exported DA3 with random weights, decoded, against the authors' own network and decoding.

Two readers are compared: ONNX Runtime with the decoding below, and, where --program names it, splat-mapper's
examples/model_answer. Fails above 1e-5, and when a wrong description of the model goes unnoticed.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("DA3_LOG_LEVEL", "WARN")

import numpy as np
import torch
from export_model import test_images
from model_export import nets, parity

# Of |difference| / max(1, |truth|).
BAR = 1e-5
# A wrong convention must differ by more than this.
GROSS = 1e-2
MEAN = torch.tensor([0.485, 0.456, 0.406]).view(1, 3, 1, 1)
DEVIATION = torch.tensor([0.229, 0.224, 0.225]).view(1, 3, 1, 1)


@dataclass
class Answer:
    """Cameras [S,4,4] (camera from the first camera's frame), focal lengths [S,2], depth and confidence [S,H,W]."""

    cameras: np.ndarray
    focal: np.ndarray
    depth: np.ndarray
    confidence: np.ndarray

    def differences(self, truth: Answer) -> dict[str, float]:
        return {name: _largest(getattr(self, name), getattr(truth, name)) for name in self.__dataclass_fields__}


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("model", type=Path, help="exported by: export_model.py da3-small --weights random")
    parser.add_argument("--network", default="da3-small", choices=("da3-small", "da3-base", "da3-large"))
    parser.add_argument("--program", type=Path, help="splat-mapper's examples/model_answer")
    parser.add_argument("--frames", default="3,4,7")
    args = parser.parse_args()
    sizes = [int(part) for part in args.frames.split(",")]
    description = json.loads(args.model.with_suffix(".json").read_text())
    images = test_images(max(sizes), description["height"], description["width"])
    net = nets.load(args.network, "random")
    failed = False
    for size in sizes:
        truth = upstream(net, args.network, images[:size])
        readers = {"onnxruntime": by_onnxruntime(args.model, description, images[:size])}
        if args.program:
            readers["splat-mapper"] = by_program(args.program, args.model, images[:size])
        for reader, answer in readers.items():
            failed |= not report(f"{reader}, {size} frames", answer.differences(truth))
    if args.program:
        few = images[: sizes[0]]
        failed |= not notices_wrong_pose(args, description, few, upstream(net, args.network, few))
    return int(failed)


def report(what: str, differences: dict[str, float]) -> bool:
    passes = max(differences.values()) <= BAR
    figures = ", ".join(f"{name} {value:.1e}" for name, value in differences.items())
    print(f"onnx_parity: {'ok' if passes else 'FAILED'} {what}: {figures} (bar {BAR:.0e})", flush=True)
    return passes


def upstream(net: torch.nn.Module, network: str, images: torch.Tensor) -> Answer:
    """The authors' forward pass and decoding, moved into the first camera's frame."""
    out = nets.upstream_answer(net, nets.FAMILIES[network], (images - MEAN) / DEVIATION)
    cameras = np.tile(np.eye(4), (len(images), 1, 1))
    cameras[:, :3] = out["extrinsics"].double().numpy()[:, :3]
    focal = out["intrinsics"].double().numpy()[:, (0, 1), (0, 1)]
    return Answer(_in_first(cameras), focal, out["depth"].numpy(), out["depth_conf"].numpy())


def by_onnxruntime(model: Path, description: dict, images: torch.Tensor) -> Answer:
    normalised = (images - MEAN) / DEVIATION if description["input_norm"] == "imagenet" else images
    pose, depth, confidence = parity.session(model).run(None, {"images": normalised.numpy()})
    cameras, focal = decode(pose.astype(np.float64), description["pose"], depth.shape[1], depth.shape[2])
    return Answer(cameras, focal, depth, confidence)


def decode(pose: np.ndarray, kind: str, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """The contract's pose encoding: translation, quaternion x y z w of any length, vertical and horizontal view."""
    x, y, z, w = pose[:, 3:7].T
    s = 2.0 / (pose[:, 3:7] ** 2).sum(axis=1)
    rows = (
        (1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)),
        (s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)),
        (s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)),
    )
    given = np.tile(np.eye(4), (len(pose), 1, 1))
    given[:, :3, :3] = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    given[:, :3, 3] = pose[:, :3]
    cameras = np.linalg.inv(given) if kind == "c2w" else given
    focal = np.stack([0.5 * width / np.tan(0.5 * pose[:, 8]), 0.5 * height / np.tan(0.5 * pose[:, 7])], axis=-1)
    return _in_first(cameras), focal


def by_program(program: Path, model: Path, images: torch.Tensor) -> Answer:
    with tempfile.TemporaryDirectory() as folder:
        image_file = Path(folder) / "images.f32"
        images.numpy().astype("<f4").tofile(image_file)
        command = [str(program), str(model), str(image_file), str(len(images)), folder]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        frames = json.loads((Path(folder) / "answer.json").read_text())["frames"]
        shape = (len(images), *images.shape[2:])
        depth, confidence = (
            np.fromfile(Path(folder) / name, "<f4").reshape(shape) for name in ("depth.f32", "conf.f32")
        )
    cameras = np.array([frame["cam_from_world"] for frame in frames]).reshape(-1, 4, 4)
    return Answer(cameras, np.array([[frame["fx"], frame["fy"]] for frame in frames]), depth, confidence)


def notices_wrong_pose(args: argparse.Namespace, description: dict, images: torch.Tensor, truth: Answer) -> bool:
    """A description that calls the poses by the other direction must be seen, else this comparison proves nothing."""
    with tempfile.TemporaryDirectory() as folder:
        liar = Path(folder) / args.model.name
        for path in args.model.parent.glob(f"{args.model.name}*"):
            shutil.copy(path, folder)
        wrong = description | {"pose": "w2c" if description["pose"] == "c2w" else "c2w"}
        liar.with_suffix(".json").write_text(json.dumps(wrong))
        seen = by_program(args.program, liar, images).differences(truth)["cameras"]
    print(f"onnx_parity: {'ok' if seen > GROSS else 'FAILED'} poses read the wrong way differ by {seen:.1e}")
    return seen > GROSS


def _in_first(cameras: np.ndarray) -> np.ndarray:
    return cameras @ np.linalg.inv(cameras[0])


def _largest(found: np.ndarray, truth: np.ndarray) -> float:
    if found.shape != truth.shape or not np.isfinite(found).all():
        return float("inf")
    return float((np.abs(found - truth) / np.maximum(1.0, np.abs(truth))).max())


if __name__ == "__main__":
    sys.exit(main())
