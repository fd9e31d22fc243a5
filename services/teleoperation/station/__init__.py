"""The driver's station: receives video, serves the cockpit page, sends commands.

Begin with `app`; `web` serves the page.
"""
