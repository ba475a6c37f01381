"""Parts of the collaborative Stein particle filter (CSPF).

Shapes: B worlds, H = N holders (each UAV holds a belief of its own), N agents (the poses that every
holder estimates), m particles, W matches in the window, R = N other ends of a holder's edges, P
numbers of a pose, D of a tangent vector [ρ (m), φ (rad)]. All poses are relative to UAV 0's present
one.
"""
