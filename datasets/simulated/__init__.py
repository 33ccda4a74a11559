"""A simulated drive without camera: vehicle, CAN, gyro, magnetometer, true pose."""
