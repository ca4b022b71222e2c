"""What is asked of an engine, as data: hypotheses, the channels of a launch, requests and their shards."""
