"""The live page of the event bus.

Begin with `app`; `state` and `history` hold what the page shows.
"""
