"""The protocol's messages, written by the build from proto/perturb/v1/perturb.proto."""
