"""The memory of a policy: keys of past detections."""
