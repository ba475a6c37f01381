# TEMP by lead, to be overwritten
import math, torch
from dataclasses import dataclass
from coloc_env.motion.base import Arena, Carry, Kinematics, Motion
from coloc_env.geometry import yaw_quaternion
@dataclass(frozen=True)
class Circle(Motion):
    speed: float = 0.5
    rate: float = 0.15
    def start(self, keys, arena): return {}
    def advance(self, carry, steps, arena):
        n=arena.n_uavs
        ph=torch.arange(n,device=steps.device,dtype=torch.float64)*(2*math.pi/n)
        a=(steps*(arena.dt*self.rate)).unsqueeze(-1)+ph
        c,s=a.cos(),a.sin(); r=self.speed/self.rate
        cx,cy,_=arena.centre
        p=torch.stack((cx+r*c,cy+r*s,1.5+0.3*s),-1)
        v=torch.stack((-self.speed*s,self.speed*c,0.3*self.rate*c),-1)
        return Kinematics(p,v,yaw_quaternion(a+math.pi/2)),carry
MOTIONS={"circle":Circle()}
