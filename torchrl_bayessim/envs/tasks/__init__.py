"""Known tasks: Gymnasium's MuJoCo v5 set and Gymnasium-Robotics' Fetch, one file per family."""
