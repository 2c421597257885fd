"""Policies in ONNX files, flown through OpenVINO; and ours, written as such."""
