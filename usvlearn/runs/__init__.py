"""Replays: what they save, how they go on, what TensorBoard shows of them."""
