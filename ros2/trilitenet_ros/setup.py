"""Installs the ROS 2 package; colcon runs it."""

from setuptools import setup

NAME = "trilitenet_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/trilitenet.launch.py"]),
        (f"share/{NAME}/config", ["config/trilitenet.yaml"]),
    ],
    install_requires=["setuptools", "trilitenet"],
    zip_safe=True,
    entry_points={"console_scripts": [f"perception = {NAME}.node:main"]},
)
