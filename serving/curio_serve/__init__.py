"""Pose detection on camera frames: exported models, a gRPC server, a batch command line and a client."""
