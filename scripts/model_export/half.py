"""A float32 graph -> the same graph with a float16 body and float32 inputs, outputs and delicate parts.

Works on names and types alone and runs nothing, so that its cost does not grow with the network.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

FLOAT, HALF = TensorProto.FLOAT, TensorProto.FLOAT16

# Norms and exponentials lose too much in half precision; ONNX Runtime's CPU has no half Resize.
FULL_OPS = {"LayerNormalization", "ReduceMean", "ReduceSum", "Exp", "Pow", "Sqrt", "Resize", "Range", "ConstantOfShape"}

# The pose head, whose angles need more than 11 bits, and the last convolutions before an exponential.
FULL_SCOPES = ("/cam_dec/", "/camera_head/", "output_conv2")

HALF_MAX = float(np.finfo(np.float16).max)


def to_half(model: onnx.ModelProto) -> onnx.ModelProto:
    """Rewrites `model` in place and returns it."""
    types = _element_types(model)
    full = [_stays_full(node) for node in model.graph.node]
    _retype_constants(model, full)
    _cast_at_borders(model, full, types)
    _retype_weights(model)
    del model.graph.value_info[:]
    return model


def _stays_full(node: onnx.NodeProto) -> bool:
    return node.op_type in FULL_OPS or any(scope in node.name for scope in FULL_SCOPES)


def _element_types(model: onnx.ModelProto) -> dict[str, int]:
    """Element type of every tensor. Inference sees the graph without its weights: those may pass 2 GiB."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "m.onnx"
        bare = onnx.ModelProto()
        bare.CopyFrom(model)
        onnx.save_model(bare, str(path), save_as_external_data=True, location="w", size_threshold=1024)
        shapes = onnx.shape_inference.infer_shapes(onnx.load(str(path), load_external_data=False))
    graph = shapes.graph
    types = {value.name: value.type.tensor_type.elem_type for value in (*graph.value_info, *graph.input, *graph.output)}
    types.update({tensor.name: tensor.data_type for tensor in model.graph.initializer})
    _follow_unknown(model, types)
    return types


def _follow_unknown(model: onnx.ModelProto, types: dict[str, int]) -> None:
    """ONNX cannot infer ONNX Runtime's own operators, nor what follows them; their outputs are as their inputs."""
    for node in model.graph.node:
        known = types.get(node.input[0], FLOAT) if node.input else FLOAT
        cast = next((a.i for a in node.attribute if a.name == "to"), None)
        integer = node.op_type in {"Shape", "Size", "ArgMax", "ArgMin", "NonZero"}
        for name in node.output:
            types.setdefault(name, cast or (TensorProto.INT64 if integer else known))


def _retype_constants(model: onnx.ModelProto, full: list[bool]) -> None:
    for node, stays in zip(model.graph.node, full, strict=True):
        if stays:
            continue
        for attribute in node.attribute:
            if node.op_type == "Cast" and attribute.name == "to" and attribute.i == FLOAT:
                attribute.i = HALF
            elif node.op_type == "Constant" and attribute.t.data_type == FLOAT:
                attribute.t.CopyFrom(_halved(attribute.t))


def _halved(tensor: onnx.TensorProto) -> onnx.TensorProto:
    values = np.clip(numpy_helper.to_array(tensor), -HALF_MAX, HALF_MAX)
    return numpy_helper.from_array(values.astype(np.float16), tensor.name)


def _cast_at_borders(model: onnx.ModelProto, full: list[bool], types: dict[str, int]) -> None:
    """Inserts a Cast where a float tensor goes from one side to the other, once per tensor and side."""
    graph = model.graph
    weights = {tensor.name for tensor in graph.initializer}
    is_half = {
        name: not stays and types.get(name) == FLOAT
        for node, stays in zip(graph.node, full, strict=True)
        for name in node.output
    }
    made: dict[tuple[str, int], str] = {}
    nodes: list[onnx.NodeProto] = []

    def cast(name: str, to: int) -> str:
        if (name, to) not in made:
            made[name, to] = f"{name}/{'half' if to == HALF else 'full'}"
            nodes.append(helper.make_node("Cast", [name], [made[name, to]], f"{name}/cast{to}", to=to))
        return made[name, to]

    outputs = {value.name for value in graph.output}
    for node, stays in zip(graph.node, full, strict=True):
        for i, name in enumerate(node.input):
            if types.get(name) != FLOAT:
                continue
            if name in weights:
                node.input[i] = name if stays else f"{name}{_HALF_MARK}"
            elif is_half.get(name, False) == stays:
                node.input[i] = cast(name, FLOAT if stays else HALF)
        for i, name in enumerate(node.output):
            if name in outputs and is_half.get(name, False):
                node.output[i] = f"{name}/body"
        nodes.append(node)
        for name in list(node.output):
            if name.endswith("/body") and name.removesuffix("/body") in outputs:
                nodes.append(helper.make_node("Cast", [name], [name.removesuffix("/body")], f"{name}/cast", to=FLOAT))
    del graph.node[:]
    graph.node.extend(nodes)


_HALF_MARK = "//half"


def _retype_weights(model: onnx.ModelProto) -> None:
    """Keeps of each weight the precisions that are read."""
    read = {name for node in model.graph.node for name in node.input}
    kept: list[onnx.TensorProto] = []
    while model.graph.initializer:
        tensor = model.graph.initializer.pop()
        if tensor.name in read:
            kept.append(tensor)
        if tensor.name + _HALF_MARK in read:
            half = _halved(tensor)
            half.name = tensor.name + _HALF_MARK
            kept.append(half)
    model.graph.initializer.extend(reversed(kept))
