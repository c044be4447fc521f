"""The goals that a store keeps: writes in order, checkpoints, recovery, losses."""
