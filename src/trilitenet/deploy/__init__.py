"""The deploy graph and its exports: ONNX, OpenVINO, NCNN, ExecuTorch, TensorRT, INT8, with a parity gate."""
