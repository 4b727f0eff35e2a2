"""A traceable module -> an ONNX file whose names and literal sizes are those of the contract."""

from __future__ import annotations

import inspect
import warnings
from pathlib import Path

import onnx
import torch
from torch import Tensor, nn

OPSET = 17
OUTPUTS = ("pose_enc", "depth", "depth_conf")

# Tracing with 1 or 2 frames would bake in branches that only such windows take.
FRAMES_AT_TRACE = 3

# A protobuf message ends at 2 GiB; the graph itself takes a few MiB of that.
MAX_ONE_FILE_BYTES = 1_900_000_000


def trace(module: nn.Module, images: Tensor, folder: Path, fused: bool) -> onnx.ModelProto:
    """Traces over the first frames with a free number of frames; `folder` takes the exporter's raw files."""
    example = images[:FRAMES_AT_TRACE]
    raw = folder / "traced.onnx"
    options = {}
    if "dynamo" in inspect.signature(torch.onnx.export).parameters:
        options["dynamo"] = False
    with torch.no_grad(), warnings.catch_warnings():
        # Sizes that become literals are what we want here; the comparison afterwards finds any wrong one.
        warnings.simplefilter("ignore")
        module(example)
        torch.onnx.export(
            module,
            (example,),
            str(raw),
            opset_version=OPSET,
            do_constant_folding=True,
            input_names=["images"],
            output_names=list(OUTPUTS),
            dynamic_axes={name: {0: "S"} for name in ("images", *OUTPUTS)},
            custom_opsets={"com.microsoft": 1} if fused else None,
            **options,
        )
    model = onnx.load(str(raw))
    _state_sizes(model, int(images.shape[2]), int(images.shape[3]))
    return model


def _state_sizes(model: onnx.ModelProto, height: int, width: int) -> None:
    """Writes the output sizes as literals; the exporter leaves invented names there."""
    sizes = {"pose_enc": (9,), "depth": (height, width), "depth_conf": (height, width)}
    for output in model.graph.output:
        del output.type.tensor_type.shape.dim[:]
        dims = output.type.tensor_type.shape.dim
        dims.add().dim_param = "S"
        for size in sizes[output.name]:
            dims.add().dim_value = size


def save(model: onnx.ModelProto, path: Path, external: bool) -> None:
    """Writes `path`, and its weights beside it as `<path>_data` when one file cannot hold them or `external` asks."""
    if external or _weight_bytes(model) > MAX_ONE_FILE_BYTES:
        data = path.name + "_data"
        onnx.save_model(
            model,
            str(path),
            save_as_external_data=True,
            all_tensors_to_one_file=True,
            location=data,
            size_threshold=1024,
        )
    else:
        onnx.save_model(model, str(path))
    onnx.checker.check_model(str(path))


def _weight_bytes(model: onnx.ModelProto) -> int:
    return sum(len(tensor.raw_data) for tensor in model.graph.initializer)
