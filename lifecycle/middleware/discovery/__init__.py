"""DDS discovery: range, discovery server, probes, liveliness, rediscovery, dead participants."""
