"""The feedback of goals and the statuses of all goals, for any number of followers."""
