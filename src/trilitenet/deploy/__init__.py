"""The deploy graph and its exports: ONNX, OpenVINO, NCNN, TensorRT, INT8, with a parity gate."""
