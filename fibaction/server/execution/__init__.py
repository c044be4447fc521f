"""The execution of goals: executors, and the tasks in which they run."""
