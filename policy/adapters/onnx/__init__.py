"""ONNX policies, run by OpenVINO."""
