"""The package as `colcon build` installs it. fibaction itself is installed by pip."""

from __future__ import annotations

from setuptools import setup

NAME = "fibaction_fibonacci"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/two_robots.launch.py"]),
    ],
    zip_safe=True,
    description="A node that serves the Fibonacci action with fibaction",
    license="Apache-2.0",
    entry_points={"console_scripts": [f"fibonacci_node = {NAME}.fibonacci_node:main"]},
)
