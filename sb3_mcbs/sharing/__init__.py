"""Agents elsewhere: as ONNX files, and on the Hugging Face hub."""

from sb3_mcbs.sharing.hub import load_from_hub, push_to_hub
from sb3_mcbs.sharing.onnx import export_onnx

__all__ = ["export_onnx", "load_from_hub", "push_to_hub"]
