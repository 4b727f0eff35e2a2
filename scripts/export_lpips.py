#!/usr/bin/env python3
"""LPIPS -> the ONNX file of eval.lpips_model (docs/FORMATS.md).

The linear heads come with the lpips package (version 0.1); the backbone is the user's: torchvision's published weights, a file of them, or
random numbers, which measure nothing and prove the path. Needs the packages of scripts/model_export/requirements.txt."""

import argparse
import json
import pathlib
import subprocess
import sys
import tempfile

import lpips
import numpy
import torch

# Odd and even, wide and high: the file takes any size.
CHECKED_SIZES = [(64, 64), (97, 130)]
TOLERANCE = 1e-4


def with_backbone(name, backbone):
    """The network, its backbone from torchvision's server, from a file of a state dictionary, or random."""
    is_published = backbone == "published"
    net = lpips.LPIPS(net=name, version="0.1", pnet_rand=not is_published, verbose=False)
    if backbone not in ("published", "random"):
        weights = torch.load(backbone, map_location="cpu", weights_only=True)
        with torch.no_grad():
            for key, parameter in net.net.named_parameters():
                # lpips cuts torchvision's `features` into slices and keeps the numbers of the layers.
                parameter.copy_(weights["features." + key.split(".", 1)[1]])
    return net.eval()


def export(net, file):
    """Two images of any size in, one number out."""
    example = torch.zeros(1, 3, 64, 64)
    torch.onnx.export(
        net,
        (example, example),
        str(file),
        opset_version=17,
        input_names=["rendered", "photo"],
        output_names=["distance"],
        dynamic_axes={name: {2: "height", 3: "width"} for name in ("rendered", "photo")},
        dynamo=False,
    )


def check(net, file, program):
    """The file through splat-mapper's own code against the network; the greatest relative difference."""
    worst = 0.0
    random = numpy.random.default_rng(1)
    with tempfile.TemporaryDirectory() as folder:
        for height, width in CHECKED_SIZES:
            images = random.integers(0, 256, (2, height, width, 3), dtype=numpy.uint8)
            path = pathlib.Path(folder) / "images.u8"
            path.write_bytes(images.tobytes())
            said = subprocess.run([program, str(file), str(path), str(width), str(height)], check=True, capture_output=True, text=True)
            planes = torch.from_numpy(images.astype(numpy.float32) / 127.5 - 1.0).permute(0, 3, 1, 2)
            with torch.no_grad():
                expected = net(planes[:1], planes[1:]).item()
            found = json.loads(said.stdout)["distance"]
            print(f"{width}x{height}: network {expected:.6f}, file {found:.6f}")
            worst = max(worst, abs(found - expected) / max(abs(expected), 1e-3))
    return worst


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--net", choices=["alex", "vgg", "squeeze"], default="alex")
    parser.add_argument("--backbone", default="published", help="published (torchvision downloads it), random, or a file of its weights")
    parser.add_argument("--out", type=pathlib.Path, required=True)
    parser.add_argument("--check", metavar="PROGRAM", help="the built example lpips_distance: compare the file with the network")
    options = parser.parse_args()
    torch.manual_seed(0)
    net = with_backbone(options.net, options.backbone)
    export(net, options.out)
    print(f"{options.out}: LPIPS {options.net}, backbone {options.backbone}")
    if options.check:
        worst = check(net, options.out, options.check)
        if worst > TOLERANCE:
            sys.exit(f"the file differs from the network by {worst:.2g} of its answer; allowed are {TOLERANCE}")


if __name__ == "__main__":
    main()
