"""Replays: what they save, how they resume, what TensorBoard shows of them."""
