"""What ``benchmarks/serving.py`` is made of: a network to serve, frames to send, and a generator of load."""
