"""Export one step of a policy to a file that a robot can run without this package and, with ONNX, without PyTorch."""
