"""Turns a geometry network of its authors' own package into an ONNX file that splat-mapper reads."""
