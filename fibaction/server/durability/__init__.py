"""The goals that a store keeps: writes in order, checkpoints and recovery."""
