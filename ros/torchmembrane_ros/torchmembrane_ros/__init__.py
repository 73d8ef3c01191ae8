"""A node of ROS 2: images of a soft tactile sensor in, wrench, tractions and pressure out."""
