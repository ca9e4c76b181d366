"""The HTTP service: a thin shell around a predictor, and its page.

- ``settings``: limits and options; ``process``: connection timeouts, shutdown, logs; ``command``: ``trilitenet serve``
- ``application``: the parts put together; ``guard``: what is checked, limited and counted for every request
- ``rest``: ``/v1``, probes and metrics; ``openapi`` describes them; ``inference_protocol``: ``/v2``; ``pages``: ``/``
- ``service``: the way of one image; ``batching``: the bounded queue and the network's thread
- ``intake``: untrusted bytes to an image; ``multipart``: forms to bytes
- ``metrics``: counters; ``problems``: refusals
"""
