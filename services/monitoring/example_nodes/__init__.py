"""Nodes to try the bus with: who talks, who talks as a data set says, who listens (D3.2, section 3.1)."""
