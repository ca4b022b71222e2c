"""Requests to an engine as data: hypotheses, channels of a launch, requests and their shards."""
