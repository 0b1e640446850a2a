"""The ROS package of the node, for colcon."""

from setuptools import setup

NAME = "pickplace_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/pickplace.launch.py"]),
        (f"share/{NAME}/config", ["config/cell.yaml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    maintainer="The authors of pickplace",
    maintainer_email="pickplace@example.com",
    description="Plans picks and places for a suction robot that packs items, from depth images.",
    license="MIT",
    entry_points={"console_scripts": [f"pickplace_node = {NAME}.node:main"]},
)
