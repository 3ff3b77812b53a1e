"""The status service: REST, /metrics, the web page, and the client that fetches primitives. No torch, no Ray."""
