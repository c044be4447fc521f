"""What is seen of goals: metrics, monitor, recordings and replay, traces, records of logs."""
