"""Simulated drives without camera: vehicle, CAN, gyro, magnetometer and true pose."""
