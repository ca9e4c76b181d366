"""From masks and boxes to the road: lanes as curves, camera geometry, tracking, events."""
