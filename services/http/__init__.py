"""How all services are served over HTTP: one factory for health, metrics, tokens, TLS, limits and pages.

Begin with `factory`; `settings` are the options that every service has.
"""
