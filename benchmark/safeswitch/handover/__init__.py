"""The handover protocol: the one control loop, and the exact counterfactual table of every handover step."""
