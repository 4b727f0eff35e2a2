#!/usr/bin/env python3
"""Exports VGGT or Depth-Anything-3 to the ONNX contract of splat-mapper. See docs/EXPORT.md.

Builds the authors' network from their installed package, compares the written file with it at several
window sizes, and leaves a file only when they agree.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("DA3_LOG_LEVEL", "WARN")

NETWORKS = ("da3-small", "da3-base", "da3-large", "vggt")
PATCH = 14
# Versions with which the figures of docs/EXPORT.md were taken.
PROVEN = {"torch": "2.6.0", "onnx": "1.17.0", "onnxruntime": "1.31.1"}


def main() -> int:
    """Returns the exit code: 0 written, 1 refused with one line, 2 usage."""
    args = arguments()
    missing = missing_packages()
    if missing:
        versions = " ".join(f"{name}=={PROVEN[name]}" for name in missing)
        return refuse(f"missing Python packages: {', '.join(missing)}; install them: pip install {versions}")
    from model_export.nets import Refused

    try:
        export(args)
    except Refused as refusal:
        return refuse(str(refusal))
    return 0


def refuse(reason: str) -> int:
    print(f"export_model: {reason}", file=sys.stderr)
    return 1


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("network", choices=NETWORKS)
    parser.add_argument("--weights", required=True, help="file, folder, hub repository OWNER/NAME, or random")
    parser.add_argument(
        "--height", type=side, required=True, help="image height, a multiple of 14; fixed in the file"
    )
    parser.add_argument("--width", type=side, required=True, help="image width, a multiple of 14; fixed in the file")
    parser.add_argument("--out", type=onnx_path, required=True, help="FILE.onnx; FILE.json is written beside it")
    parser.add_argument(
        "--precision", choices=("f32", "f16"), default="f32", help="of the body; in- and outputs are f32"
    )
    parser.add_argument("--s-max", type=int, default=16, help="most frames per window that the file may be asked for")
    parser.add_argument("--check-frames", type=counts, default=(1, 2, 4), help="window sizes to compare, as 1,2,4")
    parser.add_argument(
        "--attention",
        choices=("fused", "plain"),
        default="fused",
        help="fused: one ONNX Runtime node, memory linear in frames; plain: standard operators, for TensorRT",
    )
    parser.add_argument("--external-data", action="store_true", help="weights in FILE.onnx_data, however small")
    parser.add_argument("--licence", help="licence of the weights, when it is not the one of the published weights")
    args = parser.parse_args()
    if not 1 <= max(args.check_frames) <= args.s_max:
        parser.error(f"--check-frames {max(args.check_frames)} is above --s-max {args.s_max}")
    return args


def side(text: str) -> int:
    """An image side: whole patches, at most what the position embeddings were trained near."""
    value = int(text)
    if value < PATCH or value % PATCH or value > 2016:
        nearest = min(max(PATCH, round(value / PATCH) * PATCH), 2016)
        raise argparse.ArgumentTypeError(f"{value} is no multiple of 14 from 14 to 2016; nearest is {nearest}")
    return value


def onnx_path(text: str) -> Path:
    path = Path(text)
    if path.suffix != ".onnx":
        raise argparse.ArgumentTypeError(f"must end in .onnx: {text}")
    return path


def counts(text: str) -> tuple[int, ...]:
    values = tuple(sorted({int(part) for part in text.split(",")}))
    if min(values) < 1:
        raise argparse.ArgumentTypeError(f"window sizes start at 1: {text}")
    return values


def missing_packages() -> list[str]:
    missing = []
    for name in PROVEN:
        try:
            importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            missing.append(name)
    return missing


def export(args: argparse.Namespace) -> None:
    """Load, answer, patch, trace, compare, publish."""
    import torch
    from model_export import graph, nets, patches

    family = nets.FAMILIES[args.network]
    started = time.monotonic()
    net = nets.load(args.network, args.weights)
    images = test_images(max(*args.check_frames, graph.FRAMES_AT_TRACE), args.height, args.width)
    say(f"{args.network}: {sum(p.numel() for p in net.parameters()) / 1e6:.1f} M parameters")
    truth = {frames: nets.upstream_answer(net, family, images[:frames]) for frames in args.check_frames}
    say(f"the network answered for {args.check_frames} frames ({time.monotonic() - started:.0f} s)")
    module = patches.exportable(net, family, args.height, args.width, args.attention == "fused")
    args.out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=args.out.parent, prefix=".export") as folder, torch.no_grad():
        heads = nets.heads(net, family)
        (Path(folder) / "raw").mkdir()
        model = graph.trace(module, images, Path(folder) / "raw", args.attention == "fused")
        del module, net
        write_checked(args, model, images, truth, sidecar(args, heads), Path(folder))
    say(f"wrote {args.out} ({time.monotonic() - started:.0f} s in all)")


def test_images(frames: int, height: int, width: int):  # noqa: ANN201 (torch is imported late)
    """Normalised noise with structure at several scales, so that frames differ."""
    import torch
    import torch.nn.functional as F

    generator = torch.Generator().manual_seed(1)
    total = torch.zeros(frames, 3, height, width)
    for cells in (3, 8, 24):
        noise = torch.rand(frames, 3, cells, cells, generator=generator)
        total += F.interpolate(noise, size=(height, width), mode="bilinear", align_corners=True)
    return total / 3


def write_checked(args, model, images, truth, description, folder: Path) -> None:  # noqa: ANN001 (late imports)
    """Saves into `folder`, compares, and moves the files to their place when every output agrees."""
    from model_export import graph, half, nets, parity

    if args.precision == "f16":
        model = half.to_half(model)
    draft = folder / args.out.name
    graph.save(model, draft, args.external_data)
    found = parity.differences(draft, images, truth, args.precision)
    for difference in found:
        say(str(difference))
    failed = [difference for difference in found if not difference.passes]
    if failed:
        raise nets.Refused(
            f"the file does not answer as the network does ({failed[0]}); nothing was written. "
            f"Proven versions: {', '.join(f'{n} {v}' for n, v in PROVEN.items())}"
        )
    draft.with_suffix(".json").write_text(json.dumps(description, indent=1) + "\n")
    for path in folder.iterdir():
        if path.is_file():
            path.replace(args.out.parent / path.name)


def sidecar(args: argparse.Namespace, heads: int) -> dict[str, object]:
    """The description beside the file; `heads` and `attention` let the reader foresee a window's memory."""
    from model_export.nets import FAMILIES

    family = FAMILIES[args.network]
    published = "none, random weights" if args.weights == "random" else family.licence
    return {
        "contract": 1,
        "family": family.family,
        "height": args.height,
        "width": args.width,
        "patch": PATCH,
        "input_norm": family.input_norm,
        "pose": family.pose,
        "quat": "xyzw",
        "ref_frame": "first",
        "s_min": 1,
        "s_max": args.s_max,
        "precision": args.precision,
        "heads": heads,
        "attention": args.attention,
        "licence": args.licence or published,
    }


def say(text: str) -> None:
    print(f"export_model: {text}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
