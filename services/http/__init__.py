"""HTTP server of all services: health checks, metrics, tokens, TLS, limits and web pages.

Begin with `factory`; `settings` has the options that every service shares.
"""
