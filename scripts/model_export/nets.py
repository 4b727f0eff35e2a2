"""Network name and weights -> the authors' own network, and what the contract must say about it.

Knows how each package is built and loaded; knows nothing of ONNX.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

PATCH = 14

# With the published start value of 0.01 a branch of an untrained network is nearly silent,
# and a branch that the export lost would pass the comparison.
LOUD_LAYER_SCALE = 0.5

# Untrained last layers answer nearly the same everywhere; this brings depth and pose to a spread of some percent.
LOUD_LAST_LAYER = 10.0
LAST_LAYERS = ("fc_t.weight", "fc_qvec.weight", "output_conv2.2.weight")

# A quaternion of length 2, which readers must normalise, and a field of view near 1 rad, which none refuses: near 0
# its tangent would magnify rounding. VGGT adds its answer up four times.
PLAUSIBLE_POSE = {
    "cam_dec.fc_qvec.bias": (0.0, 0.0, 0.0, 2.0),
    "cam_dec.fc_fov.0.bias": (1.0, 1.0),
    "camera_head.pose_branch.fc2.bias": (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5, 0.25, 0.25),
}


class Refused(Exception):
    """The export cannot be done; the text says why and what to do."""


@dataclass(frozen=True)
class Family:
    """What the sidecar file says of a network and its published weights."""

    family: str
    package: str
    install: str
    input_norm: str
    pose: str
    licence: str
    repo: str


# Parts of the networks that reach the file; the rest may be absent from the weights.
EXPORTED_PARTS = ("backbone.", "head.", "cam_dec.", "aggregator.", "camera_head.", "depth_head.")
UNUSED_PARTS = ("_aux.", "mask_token")

DA3_INSTALL = "pip install depth-anything-3==0.1.1 addict omegaconf einops safetensors"
VGGT_INSTALL = "pip install . in a checkout of facebookresearch/vggt"


def _da3(licence: str, repo: str) -> Family:
    return Family("da3", "depth_anything_3", DA3_INSTALL, "imagenet", "c2w", licence, repo)


FAMILIES: dict[str, Family] = {
    "da3-small": _da3("Apache-2.0", "depth-anything/DA3-SMALL"),
    "da3-base": _da3("Apache-2.0", "depth-anything/DA3-BASE"),
    "da3-large": _da3("CC-BY-NC-4.0", "depth-anything/DA3-LARGE-1.1"),
    "vggt": Family("vggt", "vggt", VGGT_INSTALL, "unit", "w2c", "VGGT License v1, non-commercial", "facebook/VGGT-1B"),
}


def load(name: str, weights: str) -> nn.Module:
    """The network in float32 with its weights, ready to answer. `weights`: a path, a hub repository or `random`."""
    family = FAMILIES[name]
    torch.manual_seed(0)
    net = _build(name, family)
    if weights == "random":
        _randomise(net)
    else:
        _take_weights(net, _state(weights, family), weights)
    return net.float().eval()


def _build(name: str, family: Family) -> nn.Module:
    try:
        if family.family == "da3":
            cfg = importlib.import_module("depth_anything_3.cfg")
            return cfg.create_object(cfg.load_config(f"depth_anything_3.configs.{name}"))
        return importlib.import_module("vggt.models.vggt").VGGT()
    except ModuleNotFoundError as missing:
        raise Refused(
            f"{name} needs the Python package {family.package}, and importing {missing.name} failed; "
            f"install it: {family.install}"
        ) from missing


def _randomise(net: nn.Module) -> None:
    """Makes every branch of an untrained network count, and its cameras pass for cameras."""
    with torch.no_grad():
        for name, weight in net.named_parameters():
            if name.endswith(".gamma"):
                weight.fill_(LOUD_LAYER_SCALE)
            elif name.endswith(("pos_embed", "token", "tokens")):
                weight.normal_(std=0.1)
            elif name.endswith(LAST_LAYERS):
                weight.mul_(LOUD_LAST_LAYER)
            elif name in PLAUSIBLE_POSE:
                weight.copy_(torch.tensor(PLAUSIBLE_POSE[name]))


def _state(weights: str, family: Family) -> dict[str, Tensor]:
    path = Path(weights)
    if path.is_dir():
        path = _only_weights_in(path)
    elif not path.is_file():
        path = _fetched(weights, family)
    if path.suffix == ".safetensors":
        try:
            from safetensors.torch import load_file
        except ModuleNotFoundError as missing:
            raise Refused("reading .safetensors needs: pip install safetensors") from missing
        return load_file(path)
    state: Any = torch.load(path, map_location="cpu", weights_only=True)
    for key in ("model", "state_dict"):
        if isinstance(state.get(key), dict):
            state = state[key]
    return state


def _only_weights_in(folder: Path) -> Path:
    for name in ("model.safetensors", "model.pt", "model.pth"):
        if (folder / name).is_file():
            return folder / name
    raise Refused(f"no model.safetensors, model.pt or model.pth in {folder}")


def _fetched(weights: str, family: Family) -> Path:
    looks_like_path = weights.startswith((".", "/")) or weights.count("/") != 1
    if looks_like_path or weights.endswith((".pt", ".pth", ".safetensors")):
        raise Refused(
            f"no weights there; give a file, a folder, random, or a hub repository, as {family.repo}: {weights}"
        )
    try:
        from huggingface_hub import hf_hub_download
    except ModuleNotFoundError as missing:
        raise Refused(
            f"fetching {weights} needs: pip install huggingface_hub; or download model.safetensors and give its path"
        ) from missing
    try:
        return Path(hf_hub_download(weights, "model.safetensors"))
    except Exception as error:
        raise Refused(
            f"could not fetch model.safetensors of {weights} ({type(error).__name__}: {str(error).splitlines()[0]}); "
            "download it by hand and give its path"
        ) from error


def _take_weights(net: nn.Module, state: dict[str, Tensor], source: str) -> None:
    """Loads what the file holds for this network, and refuses when an exported part would stay untrained."""
    wanted = net.state_dict()
    state = {_bare(key, wanted): value for key, value in state.items()}
    # Files leave out all but one name of a tensor that several layers share.
    held = {wanted[key].data_ptr() for key in wanted.keys() & state.keys()}
    missing = sorted(k for k in wanted if k not in state and wanted[k].data_ptr() not in held and _is_exported(k))
    unlike = sorted(k for k in wanted.keys() & state.keys() if wanted[k].shape != state[k].shape)
    if missing or unlike:
        faults = [f"{key} is missing" for key in missing]
        faults += [f"{k} is {tuple(state[k].shape)}, expected {tuple(wanted[k].shape)}" for k in unlike]
        raise Refused(
            f"these are weights of another network: {len(faults)} of {len(wanted)} tensors do not fit, "
            f"first {faults[0]}: {source}"
        )
    net.load_state_dict({key: state[key] for key in wanted.keys() & state.keys()}, strict=False)


def _is_exported(key: str) -> bool:
    return key.startswith(EXPORTED_PARTS) and not any(part in key for part in UNUSED_PARTS)


def _bare(key: str, wanted: dict[str, Tensor]) -> str:
    for prefix in ("model.", "module."):
        if key not in wanted and key.startswith(prefix):
            key = key[len(prefix) :]
    return key


def heads(net: nn.Module, family: Family) -> int:
    """Attention heads of the layers that look at all frames."""
    if family.family == "da3":
        return net.backbone.pretrained.num_heads
    return net.aggregator.global_blocks[0].attn.num_heads


@torch.no_grad()
def upstream_answer(net: nn.Module, family: Family, images: Tensor) -> dict[str, Tensor]:
    """What the authors' own forward pass says of S normalised frames: the truth of every comparison."""
    if family.family == "vggt":
        out = net(images[None])
        depth = out["depth"][0, ..., 0]
        return {"pose_enc": out["pose_enc"][0], "depth": depth, "depth_conf": out["depth_conf"][0]}
    poses: list[Tensor] = []
    hook = net.cam_dec.register_forward_hook(lambda _module, _inputs, pose: poses.append(pose))
    out = net(images[None], ref_view_strategy="first")
    hook.remove()
    return {
        "pose_enc": poses[0][0],
        "depth": out["depth"][0],
        "depth_conf": out["depth_conf"][0],
        "extrinsics": out["extrinsics"][0],
        "intrinsics": out["intrinsics"][0],
    }
