"""Simulated captures in the forms that other people's programs read: TUM RGB-D sequences, ROS 2 bags, MCAP."""

from __future__ import annotations
