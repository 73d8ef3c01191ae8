"""Export of the complete reconstruction as one ONNX model."""
