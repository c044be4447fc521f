"""Functions of users as executors: plain functions made actions, and the check of generators."""
