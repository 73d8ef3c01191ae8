"""A ROS 2 node that turns images of a soft tactile sensor into wrench, tractions and pressure."""
