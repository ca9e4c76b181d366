"""The deploy graph and its exports: ONNX, OpenVINO, TensorRT, INT8, with a parity gate."""
