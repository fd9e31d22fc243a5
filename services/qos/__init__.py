"""Quality of service: what services require, and what networks and machines give (docs/toolboxes.md)."""
