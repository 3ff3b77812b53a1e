"""The status service: REST, /metrics and the web page. No torch, no Ray."""
