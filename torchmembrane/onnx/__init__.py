"""The whole reconstruction as one ONNX model."""
