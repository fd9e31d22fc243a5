"""Dashboard of the event bus: a live web page.

Begin with `app`; `state` and `history` hold the data that the page displays.
"""
