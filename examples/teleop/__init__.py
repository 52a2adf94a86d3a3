"""A small robot driven over a radio link: the whole system behind manifests/teleop.lifecycle.yaml.

`models` is plain Python (geometry, power, drawing, steering) and knows no ROS; `nodes` wraps each
model in a node. Nodes share nothing but topics.
"""
