"""A policy of jetbot_mjx in NumPy alone, for Python 3.6 or newer and NumPy 1.13 or newer.

    from policy import act
    action, wheel_speeds = act(obs)            # a policy that observes numbers
    action, wheel_speeds = act(image)          # a policy that sees
    action, wheel_speeds = act(image, state)   # a policy that sees, and observes numbers too

`policy.json` describes the inputs. `act` applies the normaliser, the network, the clip to [-1, 1]
and the controller that converts an action to wheel speeds. It does not compute motor values, which
depend on the robot. `python3 policy.py` checks the policy against the recording beside it, and
measures the time of a call.
"""

import base64
import json
import os
import sys
import time
from typing import Optional

import numpy as np

ABOUT = json.loads("""{"shapes": [[7], [7], [7, 64], [64], [64, 64], [64], [64, 2], [2]], "inputs": ["obs"], "image": null, "strides": [], "activation": "tanh", "squash": true, "controller": {"max_speed": 0.8, "max_yaw_rate": 2.5, "wheel_radius": 0.05, "wheel_separation": 0.45}}""")
NUMBERS = """
AwufPl33NzzWOx0/oyMfPRuQIT/JMQ8/d/cYPcPczz7Gxfs+E+4HP3wfFT9Q36U+gwKNPq04zD/jt/y+UMaSvn9qE78FzsA+
6Cv2vnc/9z4TDwS+TzDgvtmhuzqjFk8+ex4cv772Nz5ydR6/CATJvq3iyz6/XwW/yF4EP7iFG75GThE/11ekvB+PgT4m9k6+
M/BWPis/xr5sjDI/4QqWPgtlJj/IgI07VGLgvjS7Az3dhpa7hn3wPq9S6D4lRvU8PwK2vlhx4D5iwMm9c1/JvqA9tb2dkD4/
24/qPmvYMD8jwTS/+eurveuLH79k0Au+XGyqvtXCjD01Lgk/mPUmPcDT9r1cB4C+Weo6vKjAg74jMR69Hk7svs66obzFv4S+
QMpOvgfdrr3XmyU/RiU4vquCmj6TBSE9gaudvvI3KL3IMds93Re5vrwPGj83xUy+3Tn4PuYXrb4O2AS+NLdXvli6wj4x0M09
7Z0HP706EL9xUXI890HYPtLB2T74wzM96LqMvmnVMT6vDBm/YpCrPm7wl711EA6/6CnfvsAkmT63Nao9SXknPvYDbr7MWoI8
X18FvzjePL7iANm+oGkeP7qEQT6/GCY/OgHqPrnDMD5nSlS+j22SvihxVD4/7VC+z1Qdv351ED+hEOW+CB4nP4/WcT0S638+
C0/cvrxOhb7Tv+K+0gAzPmHW5b4gwz+9oD+lPhcdEb8cuao+WskMv56QJr4HHgE/0ODKPh1SAj/tHgu/UbOOPory3T46y+8+
mYjzPjoVX74t7bW+GTn3vhVczb6MSqI9SHsbPlch8T6EFJK+cp5LPtPL6T5lbr8+Ip0GPnvD0T7bBNQ97+0DPi3Kvj3SZ4s+
s7ZkPnctwb53VKK+umT+Pmii2b6u+YE+te0rvs58tb5sjew901DGPi20tj64nga/mluIPgDEuT14vN0+6SsBvz2NoD523zI+
kKEQvhHvBD50YS6+G2KgPlot0z7qPne84Bi2vknozr40F0Q+uC07PlTG4b5YL9W+7MIlP7fX4D5DXRg/9+ixvrxCHL/e/+i+
ilFKvV0lcr1jV48+cibtPk0CID95w1U+zvOevg57uD7xFIo8Y5QRv1zdKT8eGAq/VQH7vlDqGT9wDAM/beT0voqP477baDS+
Cc2cPivN273z4Hy9+zgFP4XN2750SAc/anMPv18B9b7yUpW+8FAZv2FdDr/6iX098h/jvurI7b3cdsu+eA/qvnM9j73JC7w+
b4XWPk2igLxeOau860xhPvr2tj6nW0U++Ogbvx100j26QAg/dHMOvo+myr6CrwG/FksBP4NSeD7uzma+rzsHv51AXT5Ys2Q8
yZTFPg/xqj4uqD++mMLmvooZwL6evpy+U6p/PvxaA71L7m29R8/AvdDqpr5pLNu+1RnbvsuCBj9Zrrw9ALz+PlG85747EeO+
izxKPUUpaj4JAZ6+0OERP6l1Cb8gYhm96MXaPaQwPT5bCwI+OWKMPkLn8L4/Irw80fKUvqMZGr7xlr0+H4zfvX4cJD6kuWM+
EKU7PlMSqD5bBYu+Oq/2PL3SzL61dY4+k1/5PqKN3z6H4qw9RG5xvtVhC7+6ync9m3SQPVY/MT8k46u+AE0WPyRD7r39mr29
pX/ZPuNvp74JaQa/49AzvmhG4L3/wpc+BOkvvxw2nr2XO7i+dt8LvxJ8R76IvFA8vZbsPjPUMT+E7Ik9S2p/vk5OBTzil0C+
pSoovipPBr7CYMO+Q/EtPrWihb5Qe44+aU4fvnIEnz6jCWe+MZ5lvpnOyL5TarO+uElCvr0exL6eidg+AAASP5dg9D7baeA+
5jWUu7bynD5j9SU+KKtQvq9+GD/JVra+IGgZPzr3Qj6VziE/l9g2vomHET+Gx2g8sN3EPn1kjz600Ze+d9HNPRzPX77MESA/
I/ocPwbR9z1uOXy+erH3PhOqDD79Rv4+p2IFvgJXg70A+s0+MjJdvtS8tb7eyIs+qx8+vi/Szz6xma0+dVg0PpSWDb+Mmka+
2YDePoQv/b4VFxk/QgNXPpxkjL56/QU/etOivm7jDD/CDLk+Q5cmvzelBL+LxAo/n7nHPu7CE79Rsie+GwzcvkxAsj0hEdW+
SvoVv7hXE79AW+W9VObzvisgDj9VILi+2lxRvGxt0L3dIYQ+9OSnvUISGb1suAG/8eF9vfisrz0hVR+/oGXtPu+KJj8F64w+
OauivhgwvL4zURO/SYi8vRtvxj4PMP2+AUIJvxCrib5i2SC/ZxMgP4NtI7+5C84+ZTAgPnQ6IL+Ot2Q+PoasvTqavr7tAxu/
y9qsPqNDG78DexU/CgVNPsSAz77egqs+ZyUHv8cBlr21Uta+FLHwPjV8+z3C19k+isLePQJDPr4G+xc/MiD1PaXLGb57tQO9
TdfDPjJEDr/DBGu+W20YPbbK+T3BgvK+j6EWv4RBoL6VEMI8WcHnPfsvCT8TM5W+6Mh9vH6yej0Da3I9STxGPsF7eb7xpRq+
j8MlPf869b0UYic+/xmZPLhNBr6XbAs+ox8evdA/Er5Mnyg9G4omvlG3EL582Qe+Em4LPrhWrLyH1L29zXwiPDMbh74kP6Q9
W9WJPTooGr3PmAw+kCohvpVJaD1X1BY+pAcHPntTLb7Gvje+HYw9PrDYG77dCZ8+WmHuPCnEbj7+rIG+vSYrPiUSPb4yNHk+
0LfCPatGmb3v1+M97Grjvd1AHb4LnfM9gaiSPnXlPL4hazs+xWLwvAJiUz7s+2m+9mcsPmEPG759w5e+jUIGvuBDHL4JnGO+
PUQlvbpdAD1wjJI7E+WMvtRM9z11qwG+RORpvm7BAT6bXv890AVXPeRFsrzKxy89IqhxPkiV+b2vB1S95bKxPaVd+LwNjC2+
702oPSe0+rzhbYa9XAgCPuIeOL7iWC48lQyzvN/6Mr5mS+89eM0UPjcwD76ravC9C4jgvJc7AD5AzSU+1BtHPha7Sr47UQY+
Dn4avjgxMb7RIGA+Z1VKPguahDwmJcS8Cd2dvRqBDD5i1Sw+gUMMvlbWpL2jKFI9TJGCvakuVj6AWke+3DzMvRVdJD6y08W9
9iOIPes7prwhURw+auVgvKltF77+IKO9Vb8EvoLxXD6KRtI9LPBKPtNHEr4npii+8grqvbhMKzs6Ypq9+nYDvcJKqL2yxzI8
CS4PPfHoMz74TEq+aAQ0Poyhrz08h9e9VMwDvpYXILxdf1U+JHxzPfGiyj1ZLwK+JVy1vaRmeL3fArO93nxVPjUp7b0gpRi+
QbZaPfXnOT7VZjE+xavtvRVnWL0iHB0+ADELPhw5CT7ZBK67kyUYPhKosT2SgDM+o8kZvhOVPL56NDK+4hDYPCo7/D2zsJY7
CHJBvvgmQb70K+c7k86dPcgDKb0g5yU8p8hPvd4Zxr2raK89NLrXvVwOiD3h6FW+CsPEPU8jOr4fr8M9DpgwPkhd1bwAvl09
RHqRvRkPOD4NG7A9CmKUPGV/p73biVI+fSIUvvhcID3q4ym8ASw4O1qyRz7XPBM+9QMyPvQZg72L7xE+0LsdvhYowb18lnU9
wiWBPa4Brr0/+C29UVxJPtWC+71lUK26jlwPPiU3Lj643cO9/tayvdDnTz4TGzq+Bw5mPsBbz720RcQ8WhNYvqyDXL6yboQ9
fN9GPi62nL0SEDA+hP2CPTs8hzzEpxU+esYXvj2yUD5GTZq8GYK0PX8yUL4fSYU9pvk2PpEYwTwOHSw98qGMOs1EPD54TUS7
vldMPu6RIj5jmQm9Ytu1vSBVIb513fY9PLUlPpJMTj69OQ4+ZCfcve3SMz6lECK+4XA8PEK5QT0g6VA+uIgtvgaT5r3R0Sq+
xQWBvW+fCT4zydM6IpKIPfD+FD5Zx049I82BPXr8UT2AkGI+0YIgPqnOX74xdxw+6LkdPsAtBD48V4G9ReeLvf1gNr4OZDQ9
zMn/PX5qE75Pqjm9HwBlvbGm570aOgq+iq8DPfZgJr6vmY+9TClqvGHBvjwe+KO97ak5vtLNlj0JKu89V7dLvSIhxb1D+0C+
5r9ePEa/6j3vc709jGQlvsb+YT5v1Ri8y/vEuzLaQD4KyNA9Vj0vvYsjXj2UD449yAgLvhEaKr5F5SM+EY9Dvr+oMD2zhYq8
+hw0Po+BhT1EhcG91LIlPNZSab3zQ9W9IvgRPkLwYD6EgkA+djpMvUlCOz4/NtS9Gulevj1sJD4qf0C+bNJGPaE2Gr1yfIo9
SrJLPrO2bj0lGRW+61J7vbSJKb4hcom8lAXRPEEKJb4UMUM9HqykvOnVvj27+EY9VznUvU2pkL10Tnc9I6U/vUJyDT77CSO+
zncRviKOKD7oCTk+p3xLvrY/rj067989pBfavPUCSj4wJh++z2C3PJV1I77zCmW+2S+ePKolSryfbyM9ef/BvWTRFr4GHiW+
IznDvW3wgLy7qti8xChVvakrDr69V9U9pBlCPjSHYD4F1Ey+s/LxPEtWYz1StTg+8EEwPnp4gz5Q05S7raECPtuR5DuMAxi+
QkHCvYvC873N+kw+gD4VPqOZ8T1YE6M8JHyZvWwaPr5lWak9s1Y4vDl8HL6DVN+9ELqfPD7D4L2IXS89HEr5PbkY7L3QOTo+
uRfWvPdt9b3Hak++8dfjPRM+mj0OohQ+6zUXvshFDr6oMhy+MIGEukFszbxuYjY9y8KUPfrAGD7JGh++PlliPJg+dD5IKzY+
quqsvZGgG73n+xW+im8Kvih0Vb1YKdA90L/xvRo1Hb5iYc89JoE4PiluNz6jBtg9fCE7PLmGgT4KU6E93q96Pt1m3DsUeA8+
gKsivgn+Ib6bHRm+yMVcPuuCLj27rCA9O4R1vr9e6r3gi6G9X0OQvaeiTb7wn8E9h7lNvgeIKj6D0PK80btBPqTRQr59fdM9
oqdgPg7TfL5P0VC+RvFIPlAJVL70mAQ+cKpdvTLiZT7xmD0+dBhNvZnjir0XZQc+KP01Pjm7kj0XF+c7qxuTvaUrizxTXRO9
b2MRPrwTVz28vSg++18tPvQUML5OP5o9kCLuvTqJqDwydxQ+hUX+vN14LD63iAE+/xyXPAN8F72BVNM9H20wvuC0sr26+Im6
S7UiPhlvTr7fHkM+B3kDPm95oD2T3bo9wzQQvrNZJb55Yeu9GX4jPOP+4zxBRMQ9XN2gvccQnT3mP0M9Gib1vf5csj2GWQG8
FLZWPnJyGb6vfCo8hthrPuqBQT6HQvE9iWotPeXyBr4cx989lqhZPaAoNL5kwDg+lQBFPrQXvT1p5Ye91RdyPS42JD43ZmG+
uvd3Ph39q72o+nO9Hu+2O2W9Wr4qaO69pCcgPWn82T2BFUm+2DZqPVALXb2HaDQ+6BOYPakmCr3aOLw8ICQoPsn2Aj4E9oS9
8GUwPn05QL5fSlU+i0kYvkmjdj6ZvMI8pSdOvgggPD7emHa9Y9J/u3AumT3CrS68lO5QPmwLVL44vuU9UubLvb+iNr6deZ08
KVnSvbjYwz2O3Ow9AXk0PvGo7T0voU4+TZ1RPWCSUT6f+ee91Ei2u5wpob3fgNm8mCK7vZzI4D3QXdK9FKjpvRSVtz13AgW+
sFTCPIhg4TzOzRc+1SbOvUL2PD2A3Bu+cSWHPCJNgr1R+xG+77ahPX+PRz5BgbS98jFIvh1TTD7/H4c9gZBjvtlo171NGTm+
p8tAvtSZx71mXhK+0tSCPTNrGL1Pht69XnQ6vpgFgD0CGG098JUivqV7v72Wrs09P/04PtR7GL6Msag9pv0IPmKrPj45eqy9
OGTdOUl3BT4BMd09nvqFu2teRL4/5sy9xhU1vusSSj4NPFy+ZwmFPakiY74Ebhi+xXxWvcArqz3+ymu9gGZQPIJfcj3oHSq+
XXNVPet+D76fz06+eE8IvjXbVr7Q9Z+9iT0EPv22dj2WhyA+Yd0gPiqmkj3S2c884LJ7vec/Mz7tmIG9SelBPsUckL2yVBi+
j8c6vrivKD7Spr89YeJxvXPY8b3JjwE+t0lZvlBlU72BMyA+HcgwvlJe+j29tFG9kUMNPBgWAr3Jx1w9acRhPj3/Rz4jCBC+
UxwrPpZ4MjwxyBO+Qiy6u7mtMb7xr+y9IVmJvfRFBr4L8Bm+5XHQvMWPHb5p4fM9NsJEPdsTdD1+my++c+wZPtyHX76k7pM9
bfTZvT6CpbwxWHO8MMEJPWDi1j2oPVe+VA4WPtDlRL5QPCg+RQ8YPrELUD5gsDw+jyw3PqgoLb2emHo8lyhnPjzwCL7vN+k9
0yIaPmv1rD08XTg+Pe87vF7qE76B70y9Ccofvg2LPj3gCKE9T56PPTGvE72ix509cExZvr1Sqr3dilk+ppkhPi3sEb5sN1M+
aJhnvaBwOL2XbB69KVsQPgovPzyk0am9utiwvbTMazuJvmK9au0XvslgpD3djiE9r0zyPdSCNj6JFqW8x/y0PW0GBT2DDL09
0akaPv9cJD2crAs+DDzQvf4+qDxzjda94Ni6vT6JsTygNfw90dsbvshIKb3PLZq9H3qNPWgPUT5l2Xo9Atc/vvCqLj6sUNc9
V9JxPgoSMT7Pnc29PrDDPAADwT3QNHS+JAlTvbHEJr5YMj4+6DnxvYwybD5/Ybc9C63GPZ/uor3onzm+am2BPRJg3T3DKSc+
I8iNvHm9Ez0sOLO8clXsPflrg7tsHEk+muH8veHXWb4pRls+nm4tvt1AYrp9dfq8vbcDPh+pNz0R2T+8UMpFPQu9Eb2Bkr29
caozvrVJEz5hXnu+soQovtKgD75PjPq9RoqWPQAvMz77URK++JMwPouqkzuOcTc+qUqMvad4PD1Wk3a+YWpCPvj7ID3fjNe8
SwWRPK5ZLz6vXkG+HnfSPfGoib2iQNq9KZxYOxTBRz6heEK6uvqGvhvZ9zvS1SG+ft+8Pa6kET6c8Ga+4B/bPa29NT4J8AU+
cjMbPbG5Ur5/QFq+5nTovIaRGb6vxkM+zQYCPs9G1z1GfvK91xFJvtxUHD4CSui9QtRnPS0Ffr1zOhu+lknPvc8GLD0ervC9
o3XFvZTOob0VBgW+vVkqvVe0hzydx0M95rocPp25Jz7d3oW9yrqpvFG/6TtRFv29YO2vPYs7Tj4Rzvk9B8xHPYiz+7y9TTu+
O4EIvsFc673zvg09hBsevqmFAr4hw5e9L1+CvK3cKT3B+uI8xqpNvqXgbD7vtxi+O3sEvQqzGr1a3pg999cqPhwfOT0ZPes9
39YUvcUber1qUu88g1sOPTQ0ZL5XVAm90wTWvCdMUr5jrI68no91u8PlSr4AcGE8fQKyvUb9Jj7Rigk+PS0+vq6Xxr0GOFc9
vyiBPdLxEDwKg2G9HgsrvqN6VD7abQc9RNLBPefLYT77ery9IGVdPHoI27wt7729TZYLPp1BJj4eNdw99mIOPoci3T2xumS9
x3m2vGy5GT5/UW+9Wsr+PDi1FD5npYe9XwBJPhEmmD3h39k8Oyo2PTKiCLyAYeK9wko6PQu/lTx9LCO+m1KUPA3vbL4HEHA+
vmiSPLwtcr5aYfy9bZIjvliuDT1XloO7jb01Pu4Cib3p2dG9EcYDvkwA5z3M5v28GYMgPblwCT7F6lA+hko+vvg9br0WvBg+
Di6vO8r0IL5TCa69TkQbPjLscL2bkFo+WT7vPTr26T3V4Vm+PO6Vvfrlzz1MTkO+R8QGvhpLeT33Y1w9pFv3vWuYxT387II8
TJqbPWTLAb55F9w9UH9ZPa3abDsIU6o989YDvlcDgb3f3BM9eUYkvjCkTj18RH8+EM1cvQHwnT1tMY081T/kvRFovj0KVUU+
Rc0vPoN7GT3LleM94C9ZPu2Lwr0Vyzo9LF8VvjyuCT5QU5G98fE4Pb2Xqrw21gW9/rNCPp0eMb0e7K27cH3jvafYa7y9op09
tOwCPqhZKD2+4dI9eUw5PgyUgrofBjY+eykXvrm0N739eR4+3PKNPVgC2jtU1h4+GkgpPsiSoDxh8VG92fvVPSRDPT593oC9
fpMJPh0Di71aNXQ9vNYKvpSAB77+0Sm+OiyVOyluSD556Dk7o7MEvt4VZD1SPFE+0ibNvHgOkb1viPW8gpInvtNnBz5JRYU8
CjvJPbthTL7Yegg+aprCPNWYAT6tfBS+8pwYPh2Fkj3igS0+Wccnvkc+MT5h8Jw91sG6Pbe07700ZF2+9B96PYZ7lD25bZS9
UhSMPaRpGD14uv09YTCRvc0TWT5lXKc9QvQ0vin6zLpxoP480iFdvm8LSD6WwQ6+BpGnveAsgb02eUC+7+UCPkKSMT1Z2D2+
faexPdWRAr4/kDI+v7BbvrZxlL3fm1e+Q2HAuwfGRb7ACqo8YyoivuLy3j3plTE+hDlrPcRc+j11S0G+XdR1PZOllz04ebE9
uiLlvQ+cAb5WO+W8RHwYPvBIwj27Q1S+TiETvMafnb2Ms9k8/IGavJtG5T0nqxg+Lp71PQC6UT4k7yw9epuKPYVB/Lxabsk9
8jnRPKl40TyFeas9NJjovYClN76TIy2+UqFsvdyJLT5DW/K9zlTrPW+sOL2g/3E99k4hPk1DLb52q5G9tFxYPsXWFj2Czjm+
x+49Pvq0y71o7Jc9QTcLvtqTej2hsza+N0dPPjD3dz7pKwC+datIvpRsILuUd3O9oE1JvsbaHj7ACMS9BkFeviwdDj6UI2s8
2tZovdDGwT3WubS9h8Q9PvZZbjzdGwK+K8yIvaPEu71aaPs9ITdCPjStqr3so7M9i+MpPpgfTj5Agyy+qedPvVUgvz31SqI8
19AKvYBKYT4lwYS9FeY4Pkxs8D1FERW+4dgyPi1Ktr1HvL49T0TEPA0kED5kXYm98NIGu7n5B75Cvk6+R17CvYYdL76Vb8+9
oRsDPjLgFD40rlG9WqZDPslRzb2zKty9qBMlvQJBGb48/lI+GXq/PfGZAj6DDeo9rc5WPp/kIr2mR1S9lLiBPbxERbs73zO+
NQWOveuLJD4XJSK+WjxDPhYanz2zlW08KRNcvWCt67xJAvK86p/hvR/5gzwX94w8PUlNvcXSBD33mmk9xyMRPewEIrw4CW69
fOKRvYjiED0efKs9aK1/vQl/TD51n9e8HbW+vF5BFr5Upqs8QzkKvryhIz5bZfS9QIAAPVbCqr0Mvww8nL8VvisM/L2WuSK+
gLcDPsuOBj1wlGG97teUvZIsoz2kreK8BEEYPnqv5T1IU989eY+1PK/hlb2JQVw+Bq0sviXqCz6odCm8OxRvvNj9C75dYwM+
kpe/PYdsVb7uRp88W6U3vkDqijtXi5S9dC8lPs2uRL6K3NK9ZaVAvtGXtLwfPBG9TDYPPvU7O773/EW+k00xPvfiPzzwHyK+
4XEzvWSgLT7q9So+AwpdPdtC4L05iQk9ncRnPsSyNT7rxuy9z3rhPS7JXT7ZYbe9sAVsPkGpTL4M6j++DA0Dvn8kBr0yXiO+
GvCmPMUnNT41VVM9eaKDvdsQNzxXCr09nX/QvaJGnD0bTSi9vtUQPe6CL72Xy4E8DZaDPDf0/r3qCc88evoiviXYX71PjGW9
0hcXPtILDb4fh408H5ExPlnIuj369jw9ub28PbHGb71zvRA+8IOKvKRipT0QyDC+aCTZvbGKlr268xC+trSLPZlKnz1kbOs9
SBRnvRV2rj1Xe62831cOPlsK/j38cTw87L0APi96cb5lGHw9pywfvpRMUT7SLYm9BQ24vMChGj7b/uu98NxgPSww4T3DAao9
McFzPir6UD6+bhQ+25yHvfKcS70x4ms87Qc6vrMT3LueHy6+qkihPchiGj5ABCu+jyBJPjzwED6lSTq+M3v6PcgSWTy+Mhk+
54EqPdshDL6ISu49cv6fPNWi9z0HDAo+wrmGvX2Wrbu3k/y9MWAovR6GZD6oSk++2kMBvkgTGD7hLAM+AjgxPFIM1z2HBgS+
YCaAvdUvYj1Ld609QgbvPHeHND6Y4pq9F8d5PKmRMz4eAdE9MHtuvmWjbz2r9SM+H6s4Po6Mqz2jD02+E2wePsvzHT5JYQA9
boqvPSOxET7oN4q+ehS9vWORGD4n9fG8TcIvPit89r2p0kK+FwKRvYhqxb1RmiE7oRdAvgAfUz38ON690dNbPt/4gT5TjwK+
bCI+vu6a1bx7QT6+5rj1PUVcDr6Z+j4+pjkQviBgFz7Ierk9P0/wvS4rBD60mIE9t8XPPQSeNb6k7bC8EVkxPldC2b1RkVi+
/RbGPWp4A72F3mW+F4cJvEpaSj5bsL29mmhyPqMpsr2T/j6+61GsvfL6H76bfJQ9eLQAvlLtGTyquCK++TxYvSe9LD51Uv+8
KyLIvc5KdD41/iS+MVBhvbWm8rodauG9ZftYO7anQD6IUII9tG5nPnI+Cz4b8ge+ws63vS6WUr50yPg9aZK9PeX/jj1x+Me9
u7iLPfNVMr4Wu9y9+PSLPOyNAj6rYsY9sv1CPin12Lysnjk+MN9gPjaOQL6WaiO+VLnVvZUQFT58IvY8oOthvSdQ5j1vhfo8
cyIlPuaxr70QJ/Q9YWCGPcxiZzyV25U9664IPnEFGT5wPHe9FZ3QPdjP4jzZKRG+om9YPYeh9DxkDR88FIQevgnNzT1LF7u7
cqxRvpCYGb4qkCc+cIEFPieGWj0G8DK+mIvnvYIfuL2sR2U9akAYPmBa/T1bAay9qZzqvEIpWT10wTq+vGNkPevlOr6mMZQ8
AcJUvkWo3DuDFUE+gO1wPaSJKD7PRZE9bHhQvgfBNr2u3jw+Zk+ZPTfeJz76eRs+tIEsPlFwnTvSv7e98zMCvnzMlL2xkj0+
fDUQvZEwFTyiy5a8LwQGvpJ7LT0ISdc9dCYHvuWFVL7dKmM+IpEivp0urrvJPs89gT0JvvIIPr7n2oa9wbQfPu+K1z2gJ/k8
Ul6POr3Zv7ppiE8+FoEhPm9hUL2t1M09gMUuvVyGEL75kDK+QoeGPfegRz6Kf5U9aZQbvhX557u4jwE+sC+HvcVON77FlpW9
A1lNPhEOxr37YNw7BlRjvMwjzT0Xmk++9OqwPXKJAj6QEgQ+lmxKPsgQmrpR3Ek+TzAkPi89Mz4US428dWt7vXwKQ73bDUo+
T05BPs9+Xz7+/5W930UXPuAujj0iFMU8mWINPglyTr4TkD+8PTitvXY5L761wZi9PsIjvZg3Dr5giN09p0hePouRr72lmIe9
fQcuvtYhUb4zuK69QOjhPdwcsz2uMyS7vtsHvds8+Tx9Ew2+wFhGPWu+iD0FdDA+IZchPtwO8b2bAxI+MxROvT0BRb64mge9
euZTu1LSFD2JMAu+ntFNPm9rWj1zyF0+KEh2vZ59mT2fia67It4CvfRm2L2msOE9U81HPv5MfL00Pps95NVJPkqsSD0dJDQ+
rnHXPXKuKz68gdY9g2PtvVF9Eb7tLOu9keQzPsHwTb4SdD2+jNqCvTJ7072RIeQ86p67vTdzCLz75gw7Uqn+PRdnCTyWotw9
K21SPjWACL77yS080LMXvgpx4j2lkbC9gqQUvupfAT78bGW+aV7JPbybDL5TGeA9dFvUvb3SmrwPizu91rf9vcyIcr4qrwu+
162nPOKuWr6X8Uo9WtYJvOPLNz0ng2I+1RFXvp76vLxfsES+fYNjvVpTn72T7p295fA4vnJg/L1rM+678DJaPg2X97zcVV68
6Wa6veIPpD1cQEU+RNIOvrScUT5DjQE+RuoTvqDD2D2NcWw74oXBvNseXj2xiVi+YVcqPsfNPr3aNl4+4y8dvSiZJT7x0Mm9
w6plPnbzEj6mnNo9hrdUvNexM74BOU6+juGPvUhfF76HQL09BIJ7PB60M77l2/e92ObtvXs4BT6nMJO8tm8iPuDFp7xGwoQ9
WCgMvdBKoz21X+G909GNPeHnTr6lLQY+y1A8vUd5BL0PR2O+Mkk3Pvuku70vrpq9ctIzPtycnb0XFQm+DQrQPTtt7jx+4Tq+
DZLmvX91Wj5S9T89vVuBvXpiDTteCBc+OUT2va0p+T3GKdQ8Bto7PrHcsz30Bhw++aIZPuASID0jNf895RgXvjPFoD2BsAw9
0+xDPeHjiDvbZw29w3UyPva4yT07x+A9wMmePMDVOz0nHde9b2asvRqnJz6SRHE8VcQnPLD/JL6qEG++6YBHPQk8F75863K8
Em5RPph1ED7zXIg9PbMrPphjLj7mf/e9nGRZPtsfgL1pgjs+uTBXPk7ukTv6ThI+KhiMPdDqwDstcR+8QRQdPnd+VD7Laxe9
8d13PvftRb1PSx4+/u0Eu8Yb2T1e9pM94/caPuzEIr4pdRO+XA9Gvgeyg72R8SM+0XKJu3veJDyaw+48KoaGPa3tWr43+mA9
7p1+vHaDjr1fmkw+9zwtvg4rsj0wBDI+4d+YPdfSPL5QVz4+ZIFWvgGTZ76IPBO9tylCPtOufD2lTq47QAhNvU/jeb04qQM9
G3hWvbqCNT5UY8w9GBUQPuM/YD1MoPG9TRtMu2rqjD18jgS8l9g3Pq3Kyb2pV609SaqbvbtAB775zrW92VXzvRbgFL4Ft9W9
cWcovFnttz0QHbA9elMHvniR3T3fDe+7E5nLPTC0+DxO9Mc9JIPlveDhpLukuww+qfJBvkZbID7T1Eg+hyUPPhfqvz0wIGw9
pxqcPCNqAb6nCJ08Y2dNPf5MCzx/Kxm+innevRkf+L23mTm+qp8PvouJb71ddQ0+KgIfOgE4Gb71f0C+fBoXPjrtWr0D/As+
wYsNvrPxZL4PpmG9o3okPSI4zL1aMxy9vyp0PVn5nr0hwE0+bMZPPmRsQD090XE+wAbTPZs6Iz4KoQY+/Z/sPQGADj7xteu9
pe4zvuvhBL27YDC+7GYtPqASC74Utyw+tvPLPbnjjjpCgIC9wgS+vM1DwD32DS++weHRvVoG4z1jfkk+XdYyPh2SnL2POfc9
yt4Avr9Z473vlQG+N/MXvrT2Fb4GOZO9VG7HPXZQZDwoDcO8hRk5Pq86Hj7Efs69oHeBO+izn712Rxy+bjwdPF4EYL1ZEjg8
Yp0uPJttAz7qHUS+EZ2NPWajvDxgBAI+teYzvjvIMD3L5QO92z+9PUGsK74dTEO+1YGtvLw4Sj0O1Ee+rAlgPkw1HD4pvBC+
vngFvRIgx7uNyJ49KmuJvbCfPr0NCNM9f9QIPX2KJz5ixAm9HfvHvYzM0j1yxY+96vYmvqdRTbuvmzk+I3UcvnLLIL6/Dcw9
9+D7PUc9Jb6VRKQ9btg+vUviyLxrj3A8aptQPkmXML7xeo89h+2ZPPHS+j376aA9lTTtvFJVHT4QOJe88vdevnlaFz7Bp0g+
YLsXvbMIz720OI68NF5kvi1pEL7I2ss80hHrPDVGAL6J2cW9alkLPNLqyD1BTvi9YptrPfsR9DyodK69EZYjPm8FmT03po48
rBlEvRKIB7zLLqO9Ac2svZfzPL7Kpze90gcYvq/jWz7QO+89bIYlPiIDlrzjwbO83QqHPT2O8j1evxI+eyRJPtbLXD6S/OW8
nrUGPmaNwLyy/+g8Dg7dO8cRNT0SFFY9e/YwvscXbj7KaB4+24sovYMgUT3U/NC9W2GAPI2eJr5CFBC+zAwOPuEU5z1EPIW9
44+wPcXmAr4Coyq9ivIHvoJObT5Xusu8/hAHPnnAJbxQCzA9lzEaO+8Y+byR1xq+DeIGPsM+rz1NNwo+DWxRPhgXdT6jSEi9
h5QpPoSkP764Nia+n286Prfvp7toOgI9r8NbvRrfVj7PJRQ+CtI8vsotJr4JZRa+eW4WPpFMAD4SGzO9HMhTPcfMe7zikos9
hXsUvpdQej02Ixy+/9zXvWiH2b01KyW9dZE8PWOLxz0zmXM9jsc0vgtdtD2cO+C9UF4NvpAOFj5octm7NzOUPXSf0T366fQ9
pPwWvn56vrsVbSa8Mgf3vchUYToptgM+YPcHPvC+DD6pTlU+neFTvt7xUT7XCRG+DZwLvuXbOj7smJQ9Ea86Pj/luDzGRyw+
FvC5vdhq5LyNUr27JQiEPRv0Vb73K5U94nIVvvD1pjsreve9d0iBPqlIdL0wK469WEQtviHQEz7cFQu9REc8Pi1pIj3qOTs+
I8hGPYc/PD5aJk4+Z1tCvNhxFD1QGwm9hJMivgiyLT4+Aoi+Fxi1PE9TFL7gJ9Q9SFWtvUReqj02pOy9vGMHPtz9iz7uBvW9
lAOePdjCBz715D6+VZ0TPDgfZ75FLY+9srsePrw1Iz472X88uia9PaVsR77SMbe7auQuvh08h729IC6+cyfPPX8aOL6hHGU9
DJmNvcAWDj7EAMs9OaoYPlYsaDzBaxc+VQwYPalFhb0oFha+01USPuuOWz5zdV0+/ryTvaVbJj0obBo+DfpYvm8bDT5MWjU+
KLjBvZ73MT6C0Z4987GgvFLxYr4+MRY+AohevsNH5jw75CI+19R4vuEk1D1GMpQ9iSQlvkiFBLw6oZc9WWZwvd9vBj5skEW+
5flvPR4dWj4sulA9k9YhPS4KEL5sW/e9niUHvvsuWL7uRA+9cj9CvbanB75TAxS+AUq3vS2oDT7Cxya+qDMsvV2MZz7rsj2+
5Av1PcPiNT5fp1q+Sr5dvVmxG74RSCq+6dnyPYE//T2ChCi+7FtLvv1gSj0jj3G9W68IvmOkez3JbzW95vGNPPBXhz2fR9o8
8J4IvQF0hb7iS9I8WmUqPo0YQj5NHcS9b1P4PdC/Pr6/n/g9l+YbPh5FDD6qBSa+w34JPihrsL1y8dK9QSuePeMNGb3pqsU9
EuyuvCaHPr6RfWU+1EarvVOnH770UvG9U61pPq4vbz5hGuM9lZyJPkI21D1HsNy951iAvfdADD3Ndf29TgBVPtHOuT36fy4+
ZqayveGWKL6lgPS90clMvtKj57044B4++aRIvqwBvD3wZ+69RmlBvLVnZr4nzwA+xhcJPUrBaL6FodG9ulaovX1UiL41TmG+
CJF6u8kfDr71frG9ZS8uPDqefr7wA7k9hgJOPJ+7KD3pVPi9Xc3xvX80E76d0A6+i34+vaXswjzl4wE9KKc4Pn3xbj5fcAq+
TwV/PRZ1u70Hvv48lNHOvclg5r25z088yE5CvVqhWr76YWq+NRETvpR75j2R2xG+hjWhvQOaXj4MTkK+88Qfvg7aDjxufpS+
FBoxPV2rpL33Wmu9zdguPoCBzj3J33K+zCQbvRH9jrszIJY8MwCnPfGWFLx3+w0+iGx5PCN9i7yCgtY9uOtIvglJJ77u/ES+
0SE2vn5A6730VDC+NF+yPTrDbTqM0Sq9EmwFPXNj4T2C3Tk+vT0jPp5wDj76Y5A9WDMdPTlZ7z3+E9M9fbsDPuEYDb4L98a9
qqUCPg4Mgb5c1Qo+c/QjPlpxS75Asg8+PaNyu/TqLD7LJWi9dCpEPhK7E720BwU+KTUEPlpHCL7PRUq+KrPEuy5WyD3Mdxg8
DArBPYi+Xj7MPVO+0PdbPXK+hbze7yK+mhzHvdkaz7vy6+W8Mja3vf0xJD7J4I69o8QIvZ0+b76tsh++N9ARPqrSLb5fvrU9
04JfPmfPBr7K2je+rAO1vGfDQL5wTi6+dRmiPQ8emb0p2lG9GJYnPu9+2L1Rsn09nl86vu3qKT7a7bu9WXrEPSulAz0YgiA+
ywRUPsuNSz3NfD++i0KXvSzJdL13sp497EP4O8miGT7x9AI+RBo3PlDMyT0o8Us9aE1avYBMqj1/rWo+u6Y/vjDSNj52wmE+
udaevZV59L2rOVU+4H+lPWqjnj1c9068kFBivtxsQj5vQPK9zbIAvp+e37tnq/O9GXNLvvXlEz4DERE+HvhrPvl/1D1+64c8
z/8Ivkh8E75n+xI+aKcAPi668j1YtS69JUBLPg3hZj1mKui93KGNvbvRgz2p9lA99bdxvIkURj41Vjy8hBsGvY4XWj6kNtG8
U0bmPc80jL22Yje+Td3ivcM6NT6Qbgy+oM/4vS9RFD5VmxS9StElPQV8wj2kBuM8SrUDvrOsQz6UDcc8z+zvvc+DWj7MvME9
bkNavY0dDL7qfNm9mXMnPgBXKD4GMoQ78AJEvbNIG74bUsi93265Pe4wJD6zgkC+4LU/voMhbr0Algk+oa4tPX+oOb7qm6O9
Ga5HvuJwKD7eBpY9X+Z3PcqNbj5ke2i9JcwhvQAKdL0q7Qm+hrhXPch7xrznsLy9A7OavRnTijyNiWm9vWOEPQFWdr4UGj6+
uda2PDXCYT1+3ly9n7slvjAbrD2a9Sg+Zd4oPqELsz1z1kg+w+aQvRjrRD2Rwby7f/v2vZkembx2eP+9wPzGvSDSP75SjSi+
zKTDPWyrrj3fQgu+48czPijbZr5SASy+vOwlPtAyRT3i07e9QZCoPFIkFr6P5hW+bSLhvfcK0b0J7BU+tEsrPZkJNb5gBk2+
mQI2vk13TL38eA8++aioPcPMer2Ty3I+ZtcnvhYIUD3YLzg+piToPf54ET2/b069gMFkvv2j2D2xj2e7Fy0UPruqDb4QSoK8
7+/0vRx8Mr7MG7q9HSjBPfv+zTzDT1S+NYsFvjuYdT5F/da9nXwivvb8/b0YQ+i9TH5cvggj7j3GlCg+MFFTvdI7yb1tX3a+
3Cb1PURiR76Ryg0+QwjFPRrgID7+OgS8ojK9vdyaLz3WDgs7+OKcu84Xlz2jwow9nO0aPVqaGz4womG+XXg7PWon17phNJW9
3fkYPWSFtjxTTdG96KziPRDJrL0qq4k92DAHva5+vz1IRoW+Q4mAPtQ0B76iGEu+5bIGvvW69L0Zk+09dpUavkk72z0jL3M+
85xDvZfFAD4OGAK+ctg1PoeQJD6k5se98lQ3vuEvtT27H/i9JJerPSKy9LzOczM9f6shvjSp9Lv2cg6+wPtDPoGf9732yGY9
WNNpvje+or4xEui9iovevaE3Kj7a0QG+JmUdOzM/uT2RHA6+Wfe7vYvz8D3DLYq9LbaFvXF10T1ZEAc+4l6OvVxd8jtM0Ma9
wPycPUi1Pz36gTg9+FldvgZ5JT52eIa93rAZPZd9tz0fhoY+jWKYO4LqTL7PubI9jSaivXUTxz0savA97R3mvTtTaz18AJ+9
ZMzYPZGXL7ycOCS+U8xwPsPDXr0XXTC+bM4cPSCOGL5IXSm+K4WxPeTLJb7ITFs+QpA3vhyKcz5X/N28JA8iPZxkCj5S/Lm9
fAUyPn9/sD1MFLU9OSKAvnmJ+TwvMDG+qPc1Peezeb68L1K+yrYbPtonKj3FcBK9ch8sPH+oaj3zTXE+gL8yvE+zfDyvgIy9
/+vxvVzLEj4X+BU+tm3evR/uzL1MrXI96UfAPFVSZj0Q2iU+DA2GvfiQID0VewS5OCeTvSPHmzz9klq+OGrSvbpaw7xbY/m9
QRjrveyns71MMts86vElvahQUT1S6nE99OE6vFkru7waA4w9OyQ4PY4E1T3LArW9Uew9vTewdb2E6Q0+5NQdPtGYvz2Ysz09
1rSXvTEeMT5UF/29yd1mPvBKij3Tol+9hRlqvcVIjj3tnIi9qBsivuwGUz4h6J49eS23ve5O5T3UTWQ+/rjPPWnYAr0UIgm+
vtkUPqbxOzoHPjM+ymZLPogNHD4NyNu9UJtTPtmidj0502W+LkXzvWpoCL1WNOe9VlkqPvVAIT5TyQM+9s4QvslsDT6tKaU8
+Y1ZPv69ur2uyPs9GMBPPiOmwzzK1ro9q/1MPjYo+j0SvRe+RmqkO5xHO741efo9dM46vikwA773uDg9tB07vhqE+D1ShN69
1pHTvVoCH74yIog99C9Qvn0J0D06PpC9bfpCvrVjQT5pxy++nR+xvfryEz4p0M09zTdUPh4Yej0Cwoy8lK1CvqkaI77cOk6+
NDZNvlB83L0yH5A9X75lvYRI3T38ZAG+p6kEvh0dl73zPhA8/sL7PTDQxjwIelq8M85lPHHSVT2UmNg9K1L1vYdRAD7q0+I8
x+uGvirSYr0lYya8m0OPvQCYMTuGLnC9RwkGO/YoXb5XSHo+C1MzPuuzGz6JUvs9V2gtPvBvHL4m+p29ACPQvUP+yb25C/K9
Y8mCPrbBA77nilu+6itKPlNPT740iiu9yvpKvR459r24bOq9ioAuvcG44jq4zEe+X+c1PsC7lD3aMQ49DdXBvSvvCr4N5/K9
tPphPtO9lDxKvVq+AtQGPmYnv7325XS9pi2cPfQrxzyI4FG+rOI9vmlXAb5pO5S9DOKWPdx5+TyvzQG9tLdUvd+78z3oC9o9
YjJPvvwDATzLFN087mmxvZ9TZzxDHUU+FikevOj8qzzTbok9rYwQPgRcOj6OFOs9VfkBvDekBz5/suI9T+SmPZJsWL2ltZA7
iixaPqdOtr1uEUS99bVJvkozEL6J0KS8IG7lve6Vxr0/jjW+3smKPVvmM77x7Lu9BMJhvc6viz19lEA+g2ERvNvzAj6ZnUw+
JdWDOVOYqz2Wkia+LRA8PYhFLj6tFSU+3GKrvSdiDL4auSw+zuBdvaL2g70GBwm9bUpIPoF0KT4IwKk9Mu0mvqjAxD0e3As+
yIFaPSIQyjy/3VU+wu+vvf0CYr25eGG9gUWaPVX4Sz4QnlU+LXaFvVg58L2TJRA+kqQvPhStwzzN5Qw+aCRivG/joD0j9cy9
xKH1PK1bjj2/QnA7Ar9fvjT7lzwv8/O9RBfgvXfslz05Hhq+X9UfvUJC5D0e3Ie9TSd9PCUTVT7/hU4+XhzsvbDxRb4OsBU9
PWkePu3nND2Iu5S9j/IgPveEJj69NUU+ZPbmvMF0yr1mAyW+wEcavkymSj7LAWG+4npQPn/5VT5BcqG9pO1UPWt0Pb5GHiU+
YvKQu1xw2T21/y6+srQDPXqxAj6q3H89nF+Huh3PEryuU4M889jUOxUmfj1fnkM+1RqTPXzQFT552w4+Cj1IPU+Q+b1ZxYS8
NEs3vKVATL33BuO9NvaCvZey1b3wiMg9YW9SvpJIVrxINRy+OZiIvSRvLj7rYPo9Jd3nvM7Rjztp3UO9TMcLvtYp2T12tAa+
yakJPgEwDT7Lw/s9fqSmvaevxj2giCQ+YF4PPkSZTr4EpB0+sAQuvlBZGLyP3ka+W4Okvch5OL7iY5I6+TOPPVl9Iz2TwT49
SfLKvYVkBL4hYCG+TBfrPU+Wi73YDGg9lMrTvaEN2T0XaeM9O70lvsn0AL54hpg9vAXTPQUmzb2tHL+97gUgPlaO2b0HC8q8
QrwUvRsJ/z1m6bg9o3tTPCQe/j0Wqli+usgZPg3qVb5ZV6s82/4YvfCqDL5z0ai9DIZXPtg2gD2R54+7AKIvvlnLZb7fFhg9
Yrl8PIbd/70Bn5o9F4Ffvorjbz0/iym+8RU0vXc/yr0NH20+ho5nPKAJM750XlW+ODW1vAn4YL2VcQk9isQGvmnDlr7/xxO+
z54tPfoh8Dxt6Cq9nkbTvfojRj29rZy81PdHPmON6r0YYzm+ozYsvrbzt73Y7UC+WRC7PRGBFr0v1Xy+jjIuvjUKaL0o+z48
4aEiPobQwjxDC1E+F536Pa6rVD2+RQS+92RFvp0MC74nUrE95wZVPvGCHD7oMzQ+fgt0vsTOtzzUfM29L+hJPjKhir136PS9
/hioPaqQFL6fzga9fDwtvt5Nwb3fxFu8v1WpvStTI7ySdf49nHvavYQgcT02TqI9/5/FvVGOAj6Lrs+9y/mUPdNkzT3O9AO+
ua+mPRadEb6/bJU8wlc4viWaAb49LP48ns3SPRSiTD7lAYW9NzmhvfhFML4T9k07sS39vUp5az4ax7g8QFYpPtRZNT5PThi+
I4ymPYwtAb6ErAO8aBnsPWeGrjxFQ6e9mUXivVXDEb0Ofda9O7A9vnoxaT1nOb69hdhgvqM4Fb1LlIc9yE1XvgcUpbxM8l69
45h1PhmCq72tpam9zIiQPRmH4r3ccKs9UymCPmz1Hb75NlK+H/dFvj7b+bwbPyY+4cICPo5HIT6p9Pm7XjfKPUqZcD7KYlm+
95GTvXoYuz1AQ2Q+lIbBPOxNqj0yAC0+jzksPkeHo71/v9y88tRGPgaBOT4AAwQ+UaWBvS21KL285aG96K2APRL0/LzEniS+
IVf9vcycZb135Ey+vB1xvX13br2eI12+gwg5PieIE7zPtAs+T348vvRGwj31fOo9FsWBviw1vz0eAgG+Nqo+PpAxyr31F+o9
5er6vaNwtD1QlpO9GooTPpYCp72Y47W8SC9LPq/BCz4MYLi92aTlvEU7xDsFgyU9Ru8mPn4ZAL7fyCg+wtXrvUc4Kj2lko29
vnsDPjwiDD1BjWm83bU1vhRoYb71L1O+ficzPgBbHL7d0Tc9vPtRPohBwj0qZcE9R7WWPXmLDz5LC1W9d1UqPvNqxr0XhB2+
l8ZvvXQbVT1U/0w90q8ovsMFmDxgUy++3s/1va6d/ry3TYa9Vs9RPt4u8z18BEC+o7Fcvln9Kz4bIym95NkmvqyVp73MpG69
UhcbPkeoHT2D6D0+JxJsPmmwNj42ae69mvQ1PlL2nLuTW1e+BQGpO7YDLT4FjLo9VozNPdViBz3eo2C+oEu7vT2sW7148dA9
QLDsPWIVOj7b7Rq+EfcAvX82QDzhvDQ+tJyIPYNNFT42B309e5QDPouMej0Y61c9HSsQvRzLqj0EjF89K7CyvfYJF76dtIA+
nbqiuixluLrioKa9NriXviu1Pr5yISI+t0ZoPR1FFj6rBnu853MuvqBSv71OQgk+Hb5DvpeH4b3Iq3Y+BGhDPmjh7DwO6vu6
QmjavZkrIzqlmpW9W3o/Pt1KXD7bjmi9VdSJvZZFYL0RIsa9/Gk6vjpW5L2SrZK8A35evWeAhD4lTYq9mFhAvlD+ZDxo6DW8
aR9/vsL7KT4TYyg9bBG8PSxQGj6hihi+SOQUPnqycr6SSrw9TafhvTDDCL6gA0C+gO0rvmJhDj7hHTA+3QyyPSGdTLz7vTw+
VhrcvJqZLT5lsU0+OfkvPq30XT6JXdW9mNPUPR7/HL6UZyi+rV4EvaQuLb5HsZC9seyTPTODi72Hj/U7m1NMvp6bF75pbzW7
I/TNvcJeH74HZNS9VOEdPtJBKr5kFeE79j3+vAdDGD4figU+Pkg/vDc8rLxshVc+gg2TPQBMJz6/bNW9yQcevvpjI76dGSA+
t8IcPjH9Rz6ETZK88wdjvtCALz5jXYg8C+AQvuUOQr2Kx7Q9igwMPtQZuj1ey1Y6SvULvm8wPz7Juyy+ii76vSM5lT2HfQo+
/H0Rvgmk+r1Fja49ZztIvqeHAr5cPEy++zZavmv/k70Ba8k9JstiPWVZwT0K05Y9hT90vmQCmL0LpSq+MpxmPr3X9j3CCt49
1nLVPWjlnz0cry++isHovTnoQ77WCo88eBMIPYBTWT2VL749zUzwvZnUsLq2otI9NMJEPo0m/Tyr9XS94oEqPoZPzbvyziS+
RscrPvvIyz1D/L291rQkvrKIiD382wc5FGBYPTXQNT2iNPc9TntqPI5vczvW1AW+1A4BPSFCJD1MTn+9gtWJvkSsTD4VaYG8
Yh47PpdIgD3cXiC9O5ISvq/ESzx0hg++kj0QPrUaAz6RVyg+LepGPvH9k7ySVAU9p5kPvr5nPL5TstA9MeQ0Pj8vmL1RquG9
j1WQvcWS073dtj++2lcWvZecCT3/YOq9bbQovMGOrj3pXnM+3lrbvYdaSL6ZdEm+pY64PXM8Hj5TQ629Ddorvodsxj1qVui9
zxYWvs1ZKz4E/Qy+7nMBvrs0L71Fs7e9+bgcPWgeHzwMTmW9l3QJPiReLz4VLha9yZOHPh8XTb4ipyU+sCCEvd3sKT6r8DI9
Z/OxPV/WTryxKwa+e6V1vQJfHb6FcGw8ce8ZvoZLCr3o0WA+1l71vT+KWj51FWE+EiGPPCqIAz0wFxq+Cw6xvLWz6D2Z5Qi+
pP26vTu3bT545G8+QjXkvEQ3MT6vdw6+u81SPsxVazvFQIM9bjIGvrHUZL01GcG9JAGUPV1XaL0cTTs9W94NvmAQ8j2KRWQ9
YDY/PVm3VT0ZQ+m8URcavsrr8L1+5nO7wcEpPuoALb750by9hEXsvZ/gdr6JVxu+jv4qPnnL9b2YEW09wPJwPoheIj5k1SE+
57e2vTvspj2x31s+e8hDvgUp37zvC5E929c2vVnnfz4EJtq7ugtIPqOG3j2GpDe+sGnZPRGWhLyHXOA9EQQDviVcIj4hvwY+
YEUFPjpREj5ZzaM9r3YEPuVH1r2dOjo98+tWvgG7RL4maFY+UCVcvu/457y2sDw+Fqjnu/6nR76aETA+u0ZKPnpEDb41aAC+
Ww8VPoSvBz5ix2Q+aPqBvImb+z2OC6i9+lw8PmCHgL6VWsw9qliEvbmbN7kpP9S9nTLDvUVt0byE1A8+deULvvMO/rw4M8+9
ewFOPfiOOr75H4w7bOZYvsg+H77Ik229I+gbPm5GNj5NVn+9OdfPvSNeGr5AMPE97YcqPuyo/LzcpcQ9m7QXPkqWyT0usEy9
hKfkPb9iDT6MSxM+RtsyPoK+Nb5OrBQ9obk+PVNHTTx9IQG+8TE6PndU/bpVXFQ+yjZIPgJQtT2nz2S86gbRvWEbWb4Xtr49
9ginvcz6hbzvkZ89e0esva5BAL7EUam8ow4FPtPQrrrRLsy9o9Djvcb/j71p0Qq+T6sYPvtBP7yqYaO7M3SavQ6c8r3+vbG9
gWXlPR40qj1IoUE+QaovviOMxjyywvu8zGFKPpDgwD3phiM+aV0IvpxUWLyoZWe+L3IpPk/ecb1ygzU+V7SpPTMsVr1EY+A9
nBaNu5A0A75H5xK+GjWQPcjUPj5Uw7I9BtLzPTaF1L2GC0++bvVMPczfSL4B3iA9pxboPTTb9j35QsC8r7yQO+aY0736uR8+
R6uTvYgTgzzB/ee8L9JIvq9RXTzdNzA+v70gvYjW5Tz3YyU+PhlUvvVJYjqNWKa8sAb3vYNchb1mY7C9U2AkvoV3SD6uvzG8
Y5qHvFCpIb77Kpu87zQZPh3wO77K/TO+3UFrPiqy5z2oAy6+so8Gvu7ogD2Arqq9xWUdvr1vE77qVz++/fM0PTGLIb5XFFO8
xZMpPpJdKj7Z6+a90lVKPkD4Qr5IMCw+uL46PiyJubxzD+C9b0mgPbMrCz0KOvc9ygxavOt8MD53mPY9fOJ1Pk5P/7w52vy9
1NXjvZqxAj5liDA+gaEYvp8TAj7Fj9I9XE9hviCIGj4lmtw9Zvd1vQE41LwaUyW+juAYPgq0yz1PgjK+yn3TPKJyu72WGUM8
SLvOvXNJoz7SuX88CYEovoA20T0ICyy+Sls1PrcdNz6RzBE+rYSJvfv/W72Yy5i99WkIvXkwg7rcsau9EPy4PeQ6Hj3AxSa8
NScQvgGjyr2IKyW+PY0Lvk2lrLvTyUA+HnNvvSTOMj4FB2M9W5exPQ3VeL5S72G+D8XMvdSPpbs1Jme9Ot0XPbDaFr6JBeQ9
iQI8vYHzSb4+Ey2+m1JcvTQo5b3WuEI+X60IvfhakDw62kS+NJa4Pf2zyrvWOoi9ykyYvQcVEr4AYD0+ljMlPhxe1b3FsRO+
TpO0vaDeKLwv3ws+LPT3vJ/yfL1raU8+P8BNvrTslT1PKGq7+rIvvm+eW75ekvO93fq1PfALtb2gTtC9lp7UPDsSO77EUik+
RVctPizY1L1eFpQ75/kqvgFOVz52mNA8w1ozPsSU070IAzS+9q8CvovIoz0GIEa+HZKdPa5X4z2f4xm+yBalvVvlAj6xkrq9
evMHPlszVT4PkUY9oYfwPfuDbL7j4S++uLgAPmvdVj6UhhO+ZlziPa5DOr4Psjk+O+4IPgo6Qj78DcI8U6EsvJUX6r0vepI9
ix1jvgMbQz1PSbw9zNCEvWfD270W7xC+eYEsviARCr0bb8M9NEOdPdB3D740bl+9BK4OO3N1O743JQG+OClOPTiiZbxzCn6+
+DiAvdfsir2Co/U9XMeLPiPkKL32iwc+u8nRPTdFUj1yPa48lfkEPAsn9r0GVw+9zUcjPvr8RT1x2TS+srR6vdeCTD64DRu+
plLZvQZbvj2Smxw9KvlPPpHAFz4JHCq+VcQEPm3Wa75pDAW+Rbs8PnPMAz4fYRA+A/dAvsGNhz7DaS0+xfcGPeKpDr7LD02+
NVyDPFoikLoB/J29uyVmPsLsCz7Vq+894sKJvDS1Iz5Lyki9m3xQvhpuFr2bGTG+bJhJvvyddb3Y8Qc+1ixNvtJPBT6YLy8+
bddiPsgmkL1FBC2+rW/7PVUhazwqTyG9DzSavWf4Fz6EvWU+has5PkmTVb2CEz6+MP7DvSkgWL4UIFM+GLwdvpws7D3NRVs9
o4xJPqJcgj3nndw9mbdFPLckEr5ISxG+dj5Vvi11PbwDQfM9iQBnvrKAyz3a3Lq9hdcOvdXKVj1p12O+H00CvZlvWz6890q+
x+yBvfxh4b1IQgm8pU0HPS2YDr4uW6e8ilQGvhrt/j3tcQy+tW+PvAOJ7r1hRQ8+kxYjvtDwnL3bw+i9Nt8zPimRO77OxMA9
nyUzvnxDKL5e5VA+cfFlPWDPKb4lj988EHGuvb995D2C6oI+hJr8PQeNcz0aSBO+LvqdPfumFj0g7Y4++BRGvlREZb5e5F0+
6jikPfegqT3sLZa9bc46vhAnH77TvT8+mXjxPFqk2r1GCiG+h4ssvi/VCz7BFIC9/nTwPd4pYz4E5oU93jTAPNbjyj0qcs29
3g5TPP+/TT6T4hO+2kczvU6ROr7caTs7iabCvR23HT4eW7O8IsGNvX361b0BsxI+yJIWPluIozx03FO+D261vWEHrTzcmoc9
cN5MPmOSwTx4YSs9MclVvShyszzaL1W9ifFmvDSgFb5jHdQ9VOV6vdNxnr22Ltm9hHSRvcg5r70eb5K+ESIpvuwmkz1sFjK+
mIwKvuwcWL4hvps9p0WsvVbIFz39Uhk+Y3IivdNrvjwJFVG8p3STPW5fC74+S8s9vgAfvtecvLyDot49jxK5vBD1hz3lsYc+
OmgUPllh6rx+/2K9Y3kYPszAlb4/V4G9QWbJve0jTD4w2Y091kySvStBk76M+c+9qH4RvoSs572mzhs+1ulzPsS3CD35qwe9
GD6SvdJnH76IdiY+r6FNvsD8Mb3+5/09Y0B5vuqyRT0mvlW+i9nCvX91DT7Cwze+f+VLvSdtGT6Yx2s+0f/NvTrEdz1U514+
MOwhPhBSOz4kyDa+S+w0vq75wz0JWD8+Z4QXPWdH8718Xz6+E1oUvqdXRb7jRSY9k7wfPprG+b3polE9MSGnvJzXT75Kbi2+
fV7OPPD5Rz5xKIA9hRhevgj+pT3U4y8+TAQPvUYXuD1bISm+HNgYvn1fND4XSwA+F9qBvdVNDD6ipxk8CADzvRQY0r1De0I+
b3Liva63TD2tkzq+S+TrvXxtXD4cb1q9FtmQPBq6Nr7F2DA+hzUxvuQxcD5RFGa+yU8Mvh0rIj4dbhg+EeqoPSgqLb5STvI8
uRzfPY06q711lEG+odALPrApHb01VfE9KD7tvXvRir3Pr7k9e6AjPh5ps71Qsfe9XUoXPond7bvjpZ29bvfevcOhIL4dTkG+
rbNOvkqPIb58IpE9UznVPZceBL7EYTY9+PZHPi+END7LyFW+7lsfvrOaQT4Ewes9e6giPpHLGb6Bbg8+qSVNPrg0rL3I0q07
+WscuyEaHD6XwxS9sPxovTokLr4zC5U7T8wEPrABR758sQw+P8dVvS/rSD5NZDK+ddlwvgbkcD3MwUe+JSCXvcGDOr3zY2y+
1GuKPXw4CD1DAFa9musnvsofNL58ugy+aXr2vXxQQb6aucA9xDyUvA==
"""

TOLERANCE = 1e-5


def _arrays() -> list:
    flat = np.frombuffer(base64.b64decode(NUMBERS), dtype="<f4")
    arrays, start = [], 0
    for shape in ABOUT["shapes"]:
        end = start + int(np.prod(shape))
        arrays.append(flat[start:end].reshape(shape).astype(np.float32))
        start = end
    return arrays


def _activate(x: np.ndarray) -> np.ndarray:
    kind = ABOUT["activation"]
    if kind == "tanh":
        return np.tanh(x)
    if kind == "relu":
        return np.maximum(x, np.float32(0))
    if kind == "elu":
        return np.where(x > 0, x, np.expm1(np.minimum(x, np.float32(0))))
    # Swish, written with tanh because exp could overflow.
    half = np.float32(0.5)
    return x * half * (np.float32(1) + np.tanh(half * x))


_MEAN, _STD, *_REST = _arrays()
_LAYERS = list(zip(_REST[0::2], _REST[1::2]))
_CONVOLUTIONS = [(*_LAYERS.pop(0), stride) for stride in ABOUT["strides"]]
_DENSE = [_LAYERS.pop(0)] if _CONVOLUTIONS else []


def stack(image: np.ndarray, before: Optional[np.ndarray] = None) -> np.ndarray:
    """Return what `act` takes as the image, if it takes the images of several control periods.

    Call it once in every control period. `act` cannot stack, since it keeps nothing.

    Args:
      image: The newest image, uint8 of shape [height, width, 1 for grey or 3].
      before: The result of the period before; None at the start: copies of the image.

    Returns:
      The images along the channels, the newest last.
    """
    if before is None:
        return np.tile(image, (1, 1, ABOUT["image"][2] // image.shape[2]))
    return np.concatenate([before[:, :, image.shape[2] :], image], axis=2)


def _normalised(numbers: np.ndarray) -> np.ndarray:
    x = np.asarray(numbers, np.float32)
    if x.ndim == 0 or x.shape[-1] != _MEAN.size:
        raise ValueError(f"the observation has the shape {x.shape}, not {_MEAN.size} numbers")
    return (x - _MEAN) / _STD


def _features(image: np.ndarray) -> np.ndarray:
    image = np.asarray(image)
    if image.dtype != np.uint8 or list(image.shape[-3:]) != ABOUT["image"] or image.ndim > 4:
        raise ValueError(
            f"the image is {image.dtype} of shape {image.shape}, not uint8 of {ABOUT['image']}"
        )
    x = image.reshape((-1, *image.shape[-3:])).astype(np.float32)
    for kernel, bias, stride in _CONVOLUTIONS:
        x = np.maximum(_convolve(x, kernel, stride) + bias, np.float32(0))
    x = x.reshape(x.shape[0], -1)
    for kernel, bias in _DENSE:
        x = np.maximum(np.dot(x, kernel) + bias, np.float32(0))
    return x.reshape((*image.shape[:-3], -1))


def _convolve(x: np.ndarray, kernel: np.ndarray, stride: int) -> np.ndarray:
    side, channels = kernel.shape[0], kernel.shape[2]
    count, height, width, _ = x.shape
    rows, columns = (height - side) // stride + 1, (width - side) // stride + 1
    # A view of the squares that the kernel covers, each of which becomes a row of a matrix.
    every, down, right, channel = x.strides
    squares = np.lib.stride_tricks.as_strided(
        x,
        (count, rows, columns, side, side, channels),
        (every, stride * down, stride * right, down, right, channel),
    )
    squares = squares.reshape(count * rows * columns, side * side * channels)
    return np.dot(squares, kernel.reshape(squares.shape[1], -1)).reshape(count, rows, columns, -1)


def act(obs: np.ndarray, state: Optional[np.ndarray] = None) -> tuple:
    """Return the action and the wheel speeds for one observation or a batch.

    Args:
      obs: Numbers of shape [obs] or [n, obs], in the order and the units of `policy.json`. A policy
        that sees takes the image here, uint8 of shape [height, width, channels], or n of them.
      state: The numbers beside the image, of shape [state] or [n, state]; None: there are none.

    Returns:
      The action in [-1, 1], and the wheel speeds (left, right) [rad/s] that it commands, before the
      limits of any motor; for a batch, one row each.

    Raises:
      ValueError: The observation has another shape or type, or there are too many parts.
    """
    if (state is not None) != ("state" in ABOUT["inputs"]):
        raise ValueError(f"give {' and '.join(ABOUT['inputs'])}")
    if not _CONVOLUTIONS:
        x = _normalised(obs)
    elif state is None:
        x = _features(obs)
    else:
        x = np.concatenate([_features(obs), _normalised(state)], axis=-1)
    for kernel, bias in _LAYERS[:-1]:
        x = _activate(np.dot(x, kernel) + bias)
    kernel, bias = _LAYERS[-1]
    x = np.dot(x, kernel) + bias
    if ABOUT["squash"]:
        x = np.tanh(x)
    action = np.clip(x, np.float32(-1), np.float32(1))
    return action, wheel_speeds(action)


def wheel_speeds(action: np.ndarray) -> np.ndarray:
    """Return the wheel speeds of an action, by the controller of training.

        v = (a0 + 1)/2 max_speed          w = a1 max_yaw_rate
        left = (v - w b/2) / r            right = (v + w b/2) / r

    Args:
      action: Action of shape [2] or [n, 2], in [-1, 1].

    Of a car, it is the wheel speed v / r in the middle of the rear axle, and the curvature of the
    path, a1 max_curvature.

    Returns:
      (left, right) [rad/s], in the same shape; of a car (wheel speed [rad/s], curvature [1/m]).
    """
    about = ABOUT["controller"]
    if "action_size" in about:  # only the robot's own function knows what an action means
        return action
    speed = np.float32(0.5) * (action[..., 0] + np.float32(1)) * np.float32(about["max_speed"])
    if "max_curvature" in about:
        curvature = action[..., 1] * np.float32(about["max_curvature"])
        return np.stack([speed / np.float32(about["wheel_radius"]), curvature], axis=-1)
    turn = action[..., 1] * np.float32(0.5 * about["max_yaw_rate"] * about["wheel_separation"])
    radius = np.float32(about["wheel_radius"])
    return np.stack([(speed - turn) / radius, (speed + turn) / radius], axis=-1)


def check(path: str) -> float:
    """Return the largest difference from JAX, on the recording that was exported with the policy.

    Args:
      path: Path of `recording.npz`.

    Returns:
      The largest difference of any number, wheel speeds as a share of the fastest.
    """
    about = ABOUT["controller"]
    turn = 0.5 * about.get("max_yaw_rate", 0.0) * about.get("wheel_separation", 0.0)
    fastest = (about.get("max_speed", 1.0) + turn) / about.get("wheel_radius", 1.0)
    inputs, (wanted_action, wanted_wheels) = _recorded(path)
    worst = [0.0]
    # Piece by piece, since all images at once would fill the memory of a small computer.
    for start in range(0, len(wanted_action), 100):
        piece = slice(start, start + 100)
        action, wheels = act(*(part[piece] for part in inputs))
        worst.append(np.abs(action - wanted_action[piece]).max())
        worst.append(np.abs(wheels - wanted_wheels[piece]).max() / fastest)
    return float(max(worst))


def _recorded(path: str) -> tuple:
    with np.load(path) as recording:
        inputs = [recording[name] for name in ABOUT["inputs"]]
        return inputs, (recording["action"], recording["wheel_speeds"])


def _main() -> int:
    path = os.path.join(os.path.dirname(os.path.abspath(__file__)), "recording.npz")
    if not os.path.isfile(path):
        print(f"{path} is missing: copy the whole folder")
        return 2
    worst = check(path)
    times = []
    for parts in zip(*(part[:1000] for part in _recorded(path)[0])):
        start = time.perf_counter()
        act(*parts)
        times.append(1e6 * (time.perf_counter() - start))
    print(
        f"Python {sys.version.split()[0]}, NumPy {np.__version__}: at most {worst:.1e} from JAX;"
        f" a call takes {np.median(times):.0f} microseconds, 1 in 100 more than"
        f" {np.percentile(times, 99):.0f}"
    )
    return 0 if worst < TOLERANCE else 1


if __name__ == "__main__":
    sys.exit(_main())
