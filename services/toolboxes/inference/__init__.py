"""Open Inference Protocol (KServe, version 2; Triton's client) over HTTP and gRPC.

Begin with `requests`: both servers parse a request into images with `tensors` and wait for their results there.
"""
