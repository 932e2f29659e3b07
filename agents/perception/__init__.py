"""From one robot's observation to detections."""
