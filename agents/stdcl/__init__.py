"""The spatio-temporal graph network of ST-DCL (paper, section 4.2), between optimizer and estimate.

Scalars that mean the same for any swarm gate *vectors* in metres: residuals of links along those
links, innovations, what neighbours move by. So corrections turn and mirror with the swarm, do not
notice shifts, and a swarm of another size or scale asks for nothing new.
"""
