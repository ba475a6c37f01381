"""NN-HPFF: a particle filter that a neural network restarts from a FIR filter (*Electronics* 2025,
14(21), 4346). Its figures 4–8 and table 1, its detector looked at closely, and a study beyond."""
