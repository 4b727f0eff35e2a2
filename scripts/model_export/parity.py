"""An ONNX file against the answers of the authors' network, tensor by tensor."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnxruntime
from torch import Tensor

from .graph import OUTPUTS

# Share of values whose error must stay below the limit; half precision has a few far outliers.
QUANTILE = 0.99
# Limits of |difference| / max(1, |truth|); real weights answer with values of some hundreds in depth_conf.
LIMITS = {
    "f32": {"pose_enc": 1e-4, "depth": 1e-4, "depth_conf": 1e-3},
    "f16": {"pose_enc": 1e-2, "depth": 1e-2, "depth_conf": 2e-1},
}


@dataclass(frozen=True)
class Difference:
    """Error of one output at one window size."""

    output: str
    frames: int
    largest: float
    quantile: float
    limit: float

    @property
    def passes(self) -> bool:
        return self.quantile <= self.limit

    def __str__(self) -> str:
        return (
            f"{self.output} at {self.frames} frames: largest difference {self.largest:.1e}, "
            f"99 % below {self.quantile:.1e}, limit {self.limit:.0e}"
        )


def session(path: Path) -> onnxruntime.InferenceSession:
    """The CPU provider, as memory-saving as splat-mapper runs it."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = os.cpu_count() or 1
    options.enable_mem_pattern = False
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def differences(path: Path, images: Tensor, truth: dict[int, dict[str, Tensor]], precision: str) -> list[Difference]:
    """Runs the file on the first S frames for every S in `truth`."""
    running = session(path)
    found = []
    for frames, expected in truth.items():
        answers = running.run(list(OUTPUTS), {"images": images[:frames].numpy()})
        for name, answer in zip(OUTPUTS, answers, strict=True):
            found.append(_difference(name, frames, answer, expected[name].numpy(), LIMITS[precision][name]))
    return found


def _difference(name: str, frames: int, answer: np.ndarray, expected: np.ndarray, limit: float) -> Difference:
    if answer.shape != expected.shape or not np.isfinite(answer).all():
        return Difference(name, frames, float("inf"), float("inf"), limit)
    error = np.abs(answer - expected) / np.maximum(1.0, np.abs(expected))
    return Difference(name, frames, float(error.max()), float(np.quantile(error, QUANTILE)), limit)
