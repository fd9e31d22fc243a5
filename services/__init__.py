"""Companion services, one package each, on one ROS 2 transport."""
