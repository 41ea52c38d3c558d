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

ABOUT = json.loads("""{"shapes": [[7], [7], [7, 64], [64], [64, 64], [64], [64, 2], [2]], "inputs": ["obs"], "image": null, "strides": [], "activation": "tanh", "squash": true, "controller": {"max_speed": 0.5, "max_yaw_rate": 2.5, "wheel_radius": 0.033, "wheel_separation": 0.16}}""")
NUMBERS = """
tNjCPinfwDrUGz8/AaWCO+r8GD9UyNQ+aFUfPVcNwT6/hc0+q8n1Ppvg6z7OcZo+RT0ePvigsz/Cngi/59yRvot3Eb+KypI+
4EXxvllcAD+SyhC+lGTYvobdu7zMY1Q+GLUTvy09Kj44aRW/cW7iviG94T5KrRK/OOHpPizfWb5KShE//xcZvWGSbD6zHFu+
yXKOPsno774DrjE/QreNPoy2FT/HqKG7myjrvoJhxDr2UXy7Zg4HP3Es9D53BCE7pQ+gvrwW7D78AZm9caS7vjDRB70WIyg/
pePpPkPs7z6hax+/bjWBvRZ5E78HQsy9EKajvpzxtD3lEgg/I7QJPb6iMb5OGXe+sIRWvYAkeL7blpc73S7QvlyqLTw/4Cu+
ihY/vo/wnL17QhM/ETthvuRLwj48yxQ9WkSLvsDxYr0osTQ+LoOjvpDMHT/Jhh6+3GUBP/6sv743fAG+k3sxvpUGoj7zPrE9
UPATP4SlE7+faIq9XJL7Po2ywj7cuaU9/1BlvqBtHD4kvSm/P8m1Ps4Nwrz1bw2/VFSrvsbQqj7znoA8V842PgoQaL5e9CS8
zFkKv7TfU767qeK+8ekiP29WNT4EeCk/gE/GPuXM/j0EgmS+Jbmfvqo7bT4F/Ja+QwEavw0aDT+S5uS+X/w1P7fg+rsAzlc+
kmfHvojKmb4Vk+m+t8MCPnLL576wN4W9L8u4PgTNE7/L9LM+iOEuv2ArFr6hhAU/CHXwPmAI+z7fDh6/0nWqPpz3yD443ec+
giH8PiXYqL4HaqS+6UT4vitavr5YpI49ef8KPrwF9D54JXi+w6k8PrS4CT80srE+LTHUPZvTvj682mg8rXCWPfj+yT2kE3Q+
INNCPiTkyL6ucaG++/3XPonq476YGFk+99Mpvnmfqb6CNPM9G5q+PkPcoj59C+i+7vJ/PiEkeT15PQI/gS3svjHYmz53i04+
Wfr/vQsvXT2LYjW+MXE5PulA5D4Px4a8pbahvvFFzr4n13E+5ukyPmTL5b6KD9e+Y40bPypIyj6x4fg+F8yXvokTCb/0ONS+
HD58vXq5CbtD+I8+pWn8PvY7Cj/NaiU+LS1wvpz7tD7KqPM7BsYPv1U6LD+NTAS/1cb+vjOZHj8pBPs+8GTdvhBQ5L7SAmS+
9R2RPqxx2r2TptC8AqD5PvhJA7+8PRg/8fYfv5rh175Se5C+CSQUv97zEr+IQWY9ya7Yvv96cL1gi6u+cnravquatb34RLE+
m+jUPpPoMb0l3AW9RjZJPkkrvT7Yezg+L80Wv6g5+D1incw+XQ4fvh+V0r5uaAy/CMIEPwnWVj6mi02+4AYDv8fLej4UgEU9
hf2lPk0Gnj5uXBq+sm/+vuoBqr6eVqm+ZgyCPpDbnL0616+82Rp8vfDAk74nDQ6/io3SvmeBBj8McQo+frEBP2bW6L5AT82+
8y8iPb5Pgz4GNp6+zQwVP0suB7/JVRW9TZuAPchkWz5IG/o9xFZUPker3b4EiLg8NEabvnmZCr7pcvs+4SMJvrDcRT6lRIU+
bBXhPSpiuT74Y3++JKqpPHrNur6Pb4s+qkEGP6fx5j7Cri89TwBuvkeWFL+EbDc9FgFiPQa/LD+qFMm+WA4UP0+9vL2LSZu9
M+kDP5Y0l75gMwq/A4lOvgBf6733YJc+530hvyuhOb0xN6a+gtMKv9ouWb7Ako+8bIfuPmnsIj9v+AM9aENevhC/dT2i5Gu+
oCtEvkQLyr3+k9C+tuPVPfxwlb6pYYw+LINHvqU+rz6ds1W+FVppvlUs2r5ULau+m/pZvgHq376JGcQ+Hn0IPysF8j7VX8k+
rM/Ju7g1qj7IBhw+ePcnvmH7Ez8NzcG+HBgVPwGi6z02tRg/y65fvuXAGj/IQE28r1i/Pl7HkD7DRbC+FNi7PZGbSL7Hlxs/
0tctP7s9HD66PYm+Crr6PlmGLD69hAg/QlICviFbNL2XKts+9ptBvgvDxb5xBLQ+xm0bvgObvz5tA70+8go8PspYHb+IPHK+
tATuPrgoAb8XcBI/DbR9Pv2kj77a5+4+XtSqvtgMAD/CyLY+f7Mkv6sO6r7Z4Qg/YW3FPupm8b5cEzS+4BXYvjlqhD2gmee+
hZsFv7T8Hr+yoLG9diTvviakBT/xIKK+mRkqvbiffr0onZc+qNjPvWK3vrz5EAi/LP7vveHHvT0K9x2/voLSPo3gHD/1Kp4+
qM3Cvh8Vsr6bQRy/rAjWvRKHwj698/m+knMKvyVRSL5FGwy/32ktPycmI78XYbk+/JE+PlMKJr+pZHg+goq9vf1xr749ZBu/
4jKqPrxKE785fQE/FJ0nPoaT0L7DS6Q+JajyvnvApL1Hgd2+iN32Pi7xwT0zn/k+6Q+DPdgQLr4p5hc/uaw3PToe5r1GHFu9
58DBPjV4Hr9ieEi+fzUbPYAqLT5O/Q+/dxYOv5v2or66v689dO7SPZhG/D4e4Gq+i1HhvVMmRD3XzSO9z5gsPuJhi74STD69
2AouO3UNfb2c4CA+95EsPcpcd76k924+AbX4vabdJ74AniC+Xg8MvkSkAbzyX729qzXAPa7Unb1tR8e75VuDPd4TKL68A849
lfHFPUYlw7xXZoU+hbcdvlsxyT2QRHE+XUQMPmclWb7eTfY9+QEiPnYQfr5/nm4+YurnvfV5KT49xSy+AQSUPg2jy7yC4ZU+
isHXPAnzk73XVUK9ysmcvGdsVr5kuis+OM2bPoWlH75HaTs+qAzZO8B3TD501V++SkLmPSE8U76pz8a9c9DGvWf9Xr1q7kK+
JMZAPiQ/iLtv3mY8IEFlvjudLD4q4tO9SOx0vlMSBD6gj5I9eCjfPFgVIL08aIE9GTYnPoDiF77xkxa9KGztPWHH9rx8gGa+
6B/5PYzhgL0fNoi9vdrUPWmQO76FRZM9meaLvWMNKL69rQA+b8AfPupNAr4km6u9uWqbvWleLT5Slx8+WdU9Pgu6Jr4NZZk9
UMjKvfbXJL6Bx4E+YilwPmmmqT1KrVK98lwZvecv/T0571E+UDHUvUUBHL0D1kY9woBIvW/3LT7xwSO+9KQCvnZxAT4pxf29
QMomPWofabysYRw+rkgLPaOuB742vqu9Nxssvv/XcT5OmCE+/IRBPvspGL5E6Se+IBRuvQhZYzsnboW9MdiEvCXNv71DKoU8
vBw8PMcOFj76UE++FI8jPlpNTT368vC9xEv6vT5xGjx5RHQ+BkuZPIY01D23Ng++mnOevWQQi721cWK9JDBePosU473H8BG+
cCojPUo+Jj56BDY+mqvdvdd0kb3inTw+IYMQPo0I9T0jAvo8AboXPkYLyT0+diM+lTkKvgd4Pb6mgha+KCriOpOiBT5kYjq7
QOA9vsoURb67BvQ8h6SLPTTMHL3WOei7/AEAvaGpC75J6MY9aaDXvWwBgz3mL2y+aKbtPbzRFb7Phs09TKg9PlvdLL0hIXI9
n7BavTNHKz4k55I9O34OPAkVK711jTA+mnwKvu4fHz2h9CI9lk9zOsdmSj6GByY+W9A8PvXQX73z3Bo+WUkRvoZ2wb1L+kA9
mXUcPW52kr0Zji29aEtNPqaC/73UyBm6wEcAPgQrNj6uLua9fADPvXhRUT7TljC+AkdkPgX92L2eKxg9O/Navp0+Y77nHZM9
rC49Pg2v0r3wxTE+ncDlPY6oLzxJ6Bs+QFAavuHNUT59DWC8c7++PQ8jTr6bv6w9oSYwPm5jGD1TZxM9A/zduvRPMT49Frw8
XOtEPp73IT7iGYK9QWqBvRlFNL6PycU9WMcgPpMaTD72jw0+HjTZvYV7OD7ISCW+9hWBPDxTLz3fhDQ+6N0evvDOy70sch++
c7SkvZbvDT6ldi28y91gPSwnEj708gc9Bc8hPa9ZJT0UdGE+xz02Ph2FVr5CLvo94q8mPrXd/T38Z0S9WcyCvVEGG77W0389
Fyf1PcLDBb5VtGG9wEpRvZRn0L1UogG+xdCAu0KyJr5QP5S9akcMvYkONj2mNJ+9SYIivvLMCz0/KwU+AdgDvTC4m73rPkC+
51zHO/0Uzz23o6M9k5A4vtVScD65yIm8Qm5gvJWBQz5miPU91RKivayAND2FGIc92q8CvlrJMb4YNDE+7SYovmW+QT1Vk9y8
dQwuPvJMoz0b1p+9H0g0O8dNdr3Lh9C9Fw0oPqwINz4M3hY+ZZLtvYlcOD5ouLK9whJNvr2mLD7fDRu+4ZNLPf5dkLsqYmA9
m/scPg5OSz0hwyi+CPRVvQ0TO75b/ay8NOlUvKk3Jb7iIW289ugtvRtL6D28y488lxilvRFCS71vfMo8k3YKvbzZHj6nthO+
SOMPvgyjNj4Bc0c+n11XvqsBHz1VEuA9f5zuvFW3Pz4NQB++H7eGPVarQL55S06+h7vvPHOONL3rn8I8+p6CvfnBS74BAhS+
m4JpvXEnED2i04K8hQI2vXHAKL63Xus95icGPrLEMD6KPiW+t6kAPVXFWT1agUA+dYAaPrsgSj7K1eg8kgitPWi5ZrzyZQy+
04gevjkm8L1v13w+twPxPYlQRT4i2MU8CYmWvUCEUr5bIQE+G0asPEblFb4rZAy+nDY5Pe5Jk7088I08OBD/Pa2M0L1EqTQ+
5SLGvYufM77Diha+MgpTPTwlpT3jdaI9KeUCvudOL75HaL69EN9TOxP/HjwytHM9ksdkPGdsRT5s+2W+DhIGPRpzKT4wFuw9
W+8Gvr6eB734fBy+dve7vSACGb3DirE92JYEvvVSJb5B2Rk9sO5FPowK+D01ggc+eSV1PUNDSj6zGpQ99mVIPmQXDDy//609
wS/+veEJ072ixsG9ZhwqPgsKKbpnoGk91k9pvh8V5r3G4sm9Y6USvRP0Qb7rSq49uwY0vl2MKj7MM9i8HaFnPsinNr7Gsec9
pOl1PkwZZL5i/lm+yWBMPo17dr6tSCo+WgZevQ7bfT4h4io+PAYFvWEgg726Xg8+eFoqPtdcZT2sbsM8EfQ+vVckdzwNwiq9
DhoQPpYbkzzuSh0+vHg3Pqg5Rr6EDIc90/zmvfUW3zzx3BE+iLzDvNm8DT7d50g+UXrUOgVORb0dXak9VsEyvp250b1AOsI7
8JIdPp76Mr41rjk+jN0dPtg1fz20/to99zP+vTqJC751rAi+3HocvA9DajyJX409ni2LvRWpmj3RslU9IJLuvbblwz3IMqk7
KvcsPptMCr4F+q28tb9cPjkPET5cyRU+clRQPVfyBr49R+s97WlNPYdFKr4LWCo+DFsrPu886D2B0VO9kwmVPatIKj4Pg1q+
a6pcPuw/m730Rlu9T9LOvPafCr6bY9u9j15KPRitzT3pb12+qRxpPapUf71h9jc+ZaO0PdST47z2H6o8WX1HPls9/D1RcJK9
+cAnPldtMr4ZrVw+hsxgveFQTD40nDE9ET1Uvgj/ED69jo+92JWzu3ZepD3bbis8Q85RPiemQ77Hmbw9gjqdvcCwJL6uoXU7
UHERvtQk6D2i6/89Xm5CPvRe2j0PJTw+KdEvPdnGNT5VHIO9SutpvDQfqr3Eyay8F9zivcQ4/z0yxQO+kzPavc67xD39ByW+
EKFbPO7YDj1TXAY+d9/mvRtIYD3HvBG+039QPZKzl70iQgi+achnPTOgYD5oEN69QLhBvlyYRT5Cn7A9Rr5VvpzqzL0tN1S+
Cw9Kvj9yq70/1Bu+Lai0PazGobylr969xMM3vsbLlT2GwFM9adIjvklfzL0kYts9tJ5PPmW0G75QAp49uHcUPgdpSj6Vjb+9
xnaDPDU95T058No9rH+hvDewMb4niQu+3KM5vrkAPT4ZA1a+uskDPY6SVb6y6AK+WysKvf9myz3fZHO9s3PfOpn9ZT0aWC2+
CjaJPYlJD76+YD6+ywb+vfNNRr6TOZS9FgjcPb5pOz2Bzh0+CVcwPmL5pj1dQfq7EARmvSeSMD54boq9xHdKPvtXkr309SW+
dTlMvvOSOj5noKM9l7J5vVkbeb294Mk9Hx9AvnsWGr3etyw+6vJHvlcv/z1M4ym9NhZmuztvEr1V/3g94Y9TPgc0SD4X6gy+
xegYPrsQnby44Ba+6g0bvfM0N77wPe29df2lvZYTEb5+axW+iquLvSywGL53qck9FCODPVSMnz3j1TG+LlnvPcbfXb4hPWI9
QPOlvSLQH73W4LI8c2qNPc5W8T3r+V++NHgWPgEfTr7tBxg+V+wpPnhIOj4vxkg+7eVVPnr2XL2A5187CqUxPkfb1r0z4es9
rzYhPvQ9wj07u1Q+sOSWuwL9Ab6UumO9uXtBvlDgtDx0wnM9NyvGPS/ZMr1ug7E9IhZ1vu4ol73DDjU+TIoaPgk6Er7ThzY+
MGJAvXOau7tIc5K9M1MFPiFLEz1lTaO98eW8vYJwlTzxHUq94zUevkBlhD0d1pY9+8zuPWOKNj6O5Dy9QzbzPekczTyoHdo9
J+AUPhl5IT24xOQ99qmJvYlIP7vecbi90yejvb5CjT0togA+B8UEvoSRjL0q5Ei9INHsPCaaJj7WhEs98iJAvqDuLj6x5dI9
g5xhPv1uGj7juJe9eLPPO2CElz0PcGG+NK1hvTmaFr7x2EU+SBTPveG3gD5+AtE9HHQDPpowtL1yHxu+D0EJPd4B7D0oRAE+
iXMcvCDCCT3b+aa9dZbrPQq+5Dv5lU0+BvDxvVskgL4WtRk+ZIERvsBBrL2X4zm94nwsPlXfAzzx/nu8ikhGPTp4nr1H0Oy9
v8wUvvuLIj6u54e+gsMXvmLaDL54hLS9hyCqPVc97T3t3RC+ONNEPsbjGbyb91c+Uj/pvcTt5j1T0Ii+bAsxPoi8AzxaUJW9
R5i3OoiqQD5Wwnu+C08JPpdpy7wCVvG9myoNvZM3QT79vMC8hK2Dvu3kML2o1x2+IjnlPTf4xz20W42+rp6TPebMQz4gBhc+
Ut5sPZVvTb5jmWC+HR4pvbc0ML5wsEU+fDAQPih47T0dzfy9GWYcvh+I5D08NAe+v3OnPW+Lj73pBx++RJkDvvV4STxsYPy9
EDqmvWjQxb1t5bC9UKETvf+++DzAHN09oPkAPp9mLj4H0p29HrFHvVdrrDxDjxy+tqzHPQfrGT504BY+BnqQOxg2NLuVRie+
bJEQvsRsIr5tjHk9dYorvsCt2b1xcL29WCMxvNhHED1LuIE9JfQ5vnvEZj47PTq+LJjru74Gpr1nmE09CflLPojuXj1o/7E9
ZY9rvdmB17tzQTw98SYlPb8War6f5rG8zVoSvKboT74NWeE8KTpyPWSxOb6hr5I8IQvzvX12Iz4Th+49gyMVvjeIDb7OZUw9
QnLjPW4lKT13s7m9wxNlvqdKeD4IQEc7hN3pPYDwYD781xW+PcxVPZd8lr1i6pm9K7PbPcjLQT5DHDc+ZD4fPuWHoT09Wla9
Gw1fvXgq1z1vN428u7fAvBZ/RD5wQZy8Lw9vPkBH9j3bLJk95zwGPCeFOz38Rt+996R8Per1tj11Uve9yMnQPPt7Vr5NQjY+
4Hb+PGcDU75LcjG+FNtCvmNOGT3qQUU9eHYcPoYsLr2UjQa+SNMRvo6fWj0k4To6BZC2PVbTAj5viUM+vplNvhYjAL1KM0Q+
gn8APejMmL2hGbS9kBQNPqDtqL0KaE4+zvl8PYRlBz4KllS+78+4vK9ZDD4ZRue9JSkpvpnIjj0BVL49FWoGvoAEGT6olPY6
4qrvPQ2M5L28+eQ90dWUPX9qGD1Pb9Q96SUhvijts7wGOCy8WH9IvpaZdz1UUFc+3FzJvWiTjD0GRF49/QwlvkJa5z0qsjQ+
p6ApPm0sOT0UedE9AjMpPgthzr0oVXU98MTKvVOMHT0n8YO7VZ00PZVzPbwMpUi9Yek6PtdB4L30E749RYEdvsEBzTxBEQU+
HmShPcESgToTAbo93mpyPquhIz2IA3Q++hI9vt43jTxYUC4++B6iPTowfTwMwx0+mr5APkr2yjzLsVC9sHUTPiQ5UD5uk4O9
HDUkPlrIj73W7jU9dI0TvgARK75AoRO+5UCbu8/rXT4C7QS9XtfxvZOkWj3MjEg+VprCvHdlnL1HnwK9iLMYvvu+Cj6Una47
VWDgPWgNX76dzPw9qcPpPOKb9z2xXSG+prYZPhrCyj1Rki0+9PQgvitwIz6BBck9jjKuPeHk7r2ze2C+RfqOPQOScz10h1m9
8oOFPUB7RD0QO8s90DuDvB7LSj5uQ7o9JPNBvmKN/Tyar+w5/o12vmrYPT7R7hm+LuitvU1UZb3XuD6+fgcCPuWzPj32cEW+
HoV7Peu5/73QkSQ+6wZzvncZwL0DMVC+TmDyOxDsIr6cGTQ9J3JVvmLwFT6R/z0+iuT3PEtnCj4JakG+2feGPaeUJj31hvc9
+D/5vTVj/b0HgTU8NwDLPfa4Cj66UlS+BrLsuychx700eZw8dnavvFfB3z00wgc+ZDkDPq1+RD6lcgU9c3exPfjvhL0k7V09
hiRBPLU9W7ws8ok9rFWtve9ZWr5uFC6+EJ9Xveypzj1UKgS+I4zPPY4HQL3PYtY9Y28WPpIYML5OvlG9V/9IPvUEbz0nk1W+
aQ9IPhS0vr10sMg9r4YNvjSBlj0clC++7ZEsPvJqdj6IaAu+Mx9FvrqFd7xXTIS9dmQ9vgP8Jj5lmQi+dvNVvsM/7T07Dwi8
4XWCvR6PrT1EHvS9UhY2Ps9zgDx/P9C9pHRCvV4nB77N1w0+qsQ2PpS9p73imaU9mtw+PmkcYT7GXC2+Kt8MvSM9tD1uNEQ8
Y/D6vOGPcD6zWci9QlZKPmUN6z1gciC+e5ZNPitAr73Egus9lFYzvJWeIz7su3y9wurhPKWQB77xdUa+kGTevTUNK77rbeG9
1W8YPn8DCT6Muzm9OKIzPvmcnr252hO+6w0nvQIAGL4OPVg+WT6aPaaFDz4eFRE+qYhiPooJKb2/k4G9w3aePfHhvzySuEC+
NVebvT7RIT7udfK9HAEpPk49sz1782C7EFebvbx0Qr2i3Mq8e0a5vYKvCD33aae80JcOvQsvIz3G7jQ9I3cJPbSaEbxtDGW9
StbHvTEMfj0GqpQ9v9lqvdGOhD424W+9bNUPPN0SC76iBCk9qncfvuwGGD7v6vG9HTDlPOt+xb0XF9A8vQccvsPBBr4BlRq+
fybKPcsXxzvmioe9Fg/VvYTHfj3Z+Zq8CuD/PZYV3D28Edw96aLyvHBVor2HJ0c+6fghvvKPND5GY4K8QcAxvc2fA75b2vA9
B+H8PSfhZr7e9mM98a0cvjVNnzxH0qS9qIkzPv9OWL5+uge+4P0pvvkYKL1jlXG8uh4dPk+XQb4gAkC+WCBLPpAyAr1l2B++
rfRnvVjfJz5DVBk+t5ssPeFa770WCxI9EcZePr4nWj5Pu7q98iTZPc9HbD5dybC9atJ3PuHKTb4wKgm+WDPuvQq3rrzflQO+
tpLyPGxdJz7sFBA91lo8vZAHU7zx+Lk9+Jq0vUAzjT20iBy94vpgPaHL2rwqTQi9Ml/bPP+OA760YwY97ekPvqA8lL3WMKy9
wJgLPsXkJb55jgI9GQERPoOBBT5JNVI9DDzLPXh5yr1nLhY+CSFtvHB69D1h91G+v9OmvTqKFL2OoRC+zfpyPRa8oD13vf89
YBwnvZNoxT1hOAm9Md8jPlOxFj7NhiG9Fj/LPd9Rjb6EPk49HvYdvjUwaz6/JkO9GioNPNQvAT6WMqe9Fj11PRQsmj3CHps9
veB8Pih8ZT7w0fE9qfl3vRDV/Lyt6CE8gCY/vkcMSb00xQS+ELPJPXnDJT7UOkq+XSMyPqMBEj6+oi++xbv0PVajMT0reBc+
oOvVPEaz/b0IXp89OTmzPKjd0T06eA4+SxqMvdSGFD3sNCW+su6CvLXraT4AHIC+23sYvlCIDz5owwA+PLFXPf72nD2pywi+
TraevfS8KD1vDqs9exelPEkjLz7qZam92MNXPVaJQT6TrNo951aDvr1DoTxgHCM+7R1SPtDfrj0o4l6+VlwkPucr1T09+R+9
4+7HPe1rCz73e2m+TVzwvQ4DIT7QWNm8QYcMPv/P5L0GYGC+dy3lvf9Ogb10OQs991cwvls9Mj2Q0QG+/6ApPtOvdz5HhPO9
K/s5vn6z5L3U4BC+S+DKPZEDNb7b0kw+DloJvoUfVD4OX709WdQxvbAlzT2RkZ09NnO+PTMRIr4qboe9C90IPsvLrb2EP0W+
bbfhPVXGVrx2Yz++qVPEvKvIOD6Wpqy9lkEYPhFUqL2FNRW+Xem4vUwFBb6aOfQ99TktvvhYU70Ylzm+xQi3vVa+dT4XTSU8
1YcLvefUbD7axx++z2jCveqKPj0OWOa9G0G8PKF/eD6DV4w9CARcPiZXqj37sOG9HQXxvSDeer6BtOs9LempPfo2PT2mnvC9
ZYOCPSvMK77cwaS9IcvQvHGsCj5edrc9/E89Ps4uBL0B/j0+XOhpPuk0L77TYRK+7gnrvY6kCD7Odfk8nAo4vUq33T3kdGM9
KiIhPq9Tvb1llhg+VXyIPRDJnDynMcU8H/YePqalHj6gfAW9ulGkPTWJDj0F4Ry+mTqLPTwgojzQCqw8EWkhvnYz5T0GmZG8
cio3vtmxP74aPjY+HC8NPjx+FD3SLT6+3mXZvRwUhL2YuJc94CgjPq7r1j0286m94vKuvC1/Ez2LoUG+474pPdOZE76D2sO6
AqxgvmTQbD0oris+8RCHPUReJz5hOS89sOpmvocN+7x26h8+3fxIPYbSOj5IxTo+5mA8PoDOPbx1fIC9pdEZvl/Ojr3bsyg+
vMgJvUQZXDpSFV48ocj9vVLdTD1sgKc955jnvTItO74LEEc+W7wAvmcfeTvla8Y9sDL8vXg/Nb48K1m9b9UuPv3Pyz22zBs9
Pp4jPZKpkTzDeU0+cV0vPnE0Fb20TNM9APmCvPJfIb5VoC2+pBkEPTHpVT5NzFo9uQ84vpKO4bwKuA0+CfzKvcXGPr4YNAq9
fyZdPs4cp70FMj68HodAvCt++T0o0Vi+SM7rPUZK/z2OrSA+znJdPrS2pruSvlQ+E+IMPrt9Mj71lbO81Ayivb/cd73E5D0+
9N4mPsvLUD7Xk4q9Zk8mPjVcvz3JTUk63VQVPhdWV77idCC621isvfwyJL5ld3u9lmcYvfbWDL6udMw9PVFRPvQijr1gNXq9
ywxDvnplSL509qG9LvbGPbTTyD05zxg8kE+2vDaMfrvzSgm+T9hSPVoUqD3N2So+W/QdPs/79L3u/Ak+xoCKvR/kN77xvEG9
5wp0vMKBDj1/P/+9rMQmPjwddD3kvlY+a/NNvXQuQD1zj3I8BIoqvDTwyr1qI/Q91ORHPpDIeb3Amqs9Zo5IPvPFOD2nojk+
8YsCPlAzDD5d0cA9K/uWvbH3872nruG9q0FCPgIOR7429Fm+zRxnva/7hL2GQV89qBJ5vTjPAz3y1vC8w8sUPpVYTTyQQeI9
SV9kPgidB76qFx09s0FAvhHBFj7xvpm93fsRvijtCT4YgXO+Cl3YPavfIr6napw9JDzmvWWbPL0OGpK9g5bVvSM6br4D0iK+
2YhmPBJEaL4NfP88+qPuO8anqjzG9lM+StVqvmXGubxrWUW+0KCyve3NTb2bDZi9HGZKvo4687006c+7JV1MPitQGz1/tkq9
mNimvdoqxD00uw8+VcIgvtrNRD5iUyM+Ef8dvtS9Bj4Isv66P6jQu+8i4DxhhEy+1pgdPgz+eb01Jlo+FGwpvSuiOj6Xm5y9
EEWAPpoGzT0zvQg+5TJ2vIAqPL5AqFq+XZ6Lvf9SH76RMmY9G4kePcgWTb5UeAO+dcPCvbM1nz2E6H08kVEUPixTuLx2GNw8
NStDvChjnj0J5Oq9l82QPe7iTL5CbfM9etlOvcvirrxfkIS+yvskPnuk773vLe69+rktPlTLmL1XDhy+ToTtPRFCSD2BZHK+
syXtvTZpUj7MKZQ8R4saveqMZLx1owc+b7ThvfER1T2gEuI8sdEdPpiz1j2/eRg+vwo7PsFmPT2ycxA+QE0dvgBaLT3NaxI9
Hg4gPYOPRjtC9gS9aHpCPvHFxD0T/6c9M6w6PfWzNz1fFsG9OLdgvYi2Mz5IKMw83kMDPR6gD77omnK+n50CPfjGMr6aE0Q8
MIpPPib2Gj6PEV49PTs5PpRjDD7qBO+9swlSPo/Jpb2LNUE+rBBqPkdmhrtF0gU+db6qPX7YebwZCma8JNgnPiAnQT548TS9
L+F1Pv5RDL1aWBg+mikPO1Gesj1Pcds9yW8XPj0KG768Chq+GRdAvm7aq71cCzc+9LGWvMApAj0a5pI8agHdPU99XL71tIM9
Lc/DvHilK70WazA+yIdRvvIBpj2EpCw+CBWvPeSGOb6esTo+N5NYvsKJXr4VhQ69AJ4dPl6JsD2ExQQ8La2GvTqMkbwGAQo9
lVp8vUJYPT6n0QI+Q7IfPqZKQz261fe9wIWYux7QVT3FwdC8NtMZPiYV6L0g85s9AuOZvWlwA75Oqgm+7NsCvjYAIL4Hp+i9
yTD7vJJL4j3acdY9txQOvkcZ9z1n7Rg86F2pPQWHdjzPuw0+ZSshvk1yn7wAwFc+eRY3vr8VOD42blw+4AH6PZYp+z0OLbA9
/7gTPc3a2711o8I8mpqtPfTsh7xVITC+vsfHveDevb3SsUi+p7AXvi5Iur1eJEA+XXrmvCUpKb4VCUe+Y4MaPqH6rL0jaww+
jFYUvuYwer53DD+9FE4RPHMm1b0tNyq8IzhyPenoqr3yLFk+1C9GPv4Igj2/yXo+AF/8PUlMAT79Hxk+CKvtPTEuBz6EAeW9
QX87vpDmIL0MREi+j9Y5Pv+nIb7BgCI+VRznPaBMJb1HRcO8SvYDvc362D0Ikky+lv+yvSUj9z31vj0+xvQ6Pjculr3MyNg9
RZgFvoTz6722CRu+tyMbvmXhJL5DUd29vXPSPSBRxDyuADS9P6U9PnEuND78oBS+qG5iO2c0sb0Fbye+wvvuPBR3g70g9oq7
4MlAPF6D6T3GOEK+vsoyPVzH+zzQpw8+PM4Uvnv3OT3zxuO8S723Pa8NRb4M/z++idO4vChpRj3/SDq+R+1pPotGEz7wOem9
+ASrvLr2ZbyI2rg9SPFRvREzS702S9A9yFQiPe+TJT6ZD528VQGnvTBs1z0k7IK9blwkviLoQbzQxlM+0u0svj8tLL51e5U9
304ePmUkGb7zisU94H+1vcX7RryAm+c8TrxKPtdLK74rMdU96CAkPAnFxz2vVac9v7A1vWPyLz6e1ii9c/davo7HHD6XHmc+
gKlLvXvwqr3ebmo6Vb9zvqHc+L3zsg+8gXILPXx+6L07YQu+gmQ3uw32lj0qiDa+ubmBPeTlDjqm6aG98tIhPntr2z3yxP08
rs5IvSNn+bxQirq9axeIvdO/Lr5mIui89VscvoSXfz7xDeg9qZ4uPiLEWr2fZCO8c4exPVJ56T24jug9hWQ3PsjzbT58Veu8
wJQRPhIcBbw1ogo9iScOPWaPfz3D1Hs9ta46viRgXz6w+zU+CxAsveOIqz3wdN69tHUXPR1lMr64Jxu+M6QPPtGKyT2mdse9
YtDDPbJ5572LT7e9l7KnvXTKdz6P98G9zgfjPZANA71tJmg82djePDaLhr1mVyq+uoYAPgFxWT3TyAk+UUAsPiQXdD7r3Zq8
Ny4PPrEqMr4texy+uDo1PsvgkjycGOS8sdRfve80ZD5RORU+iaE4vjAJA762Vxe+ejobPh9VCz5sYCW9cOOVPbz9obzOf509
JCA0vqb9TD2f+Ne95o4Qvs7Id71rnje9jypbPWmaUz0JV5o97Uo6vv3Wqj0jrBa+2WvivW7cBD6B5Fy9lXxZPWiVAz5dHM49
rFtLvn53P71kSlE8tmgPvoa8Mbx9tGU9mFEvPruNAz7nqHA+V90mvjMMcz4tzA6+J8QPvnO/Oj654TM8W1V0PoRNiLzLJv09
nNe1vQqxr71szBQ893nqPZ5aPb5SKWQ9P/kavpfwzzzauCC+Pat5PjAszb0K626942kLvvEypj2L9tO9ihccPgQeLT1kJz8+
ygm9PbopcT7OyWA+VlDBvB4gYbykG5+8xj8ZvrNYGz4VIYW+04y1OsdVCL7hmwM+nhFQvTTDfj1/A8+9AyjrPVE0ij6nExm+
m7efPbXNHz4/+Em+EYtFvDegTb5fIQi9eogMPtNcOD5WF8g87y3PPWSWA76tvbq7AT4zvi8bqL1l3S2+mxDnPc8YT766rYM8
wf2fvR0WCT4fIs890k03PhzmgTsW20A+yfZhPXkubb0J2Se+juPpPfcyLj7dz0o+QM6ovXm+ETy31949IxdUvrDb8j2B3zc+
bILbvbqkPj7PIG49OXxCvSahO75D9EQ+NbBivsHs7DtFpUo+zpVvvqcfiT2xEps9OtDsvXGAsjmdVK09okMgvfzeBj5BeDe+
t1daPX4KKT6z4WI9HotcPR5PHr7w/cu9EpoTvl4uN76Wgl69KsM1vRI+5L1nDRK+VSnSvWpiSD7hG1e+EKpsvWZdfz7+iSu+
wp7CPcSyLj4Shk++uZOFvcmJCL4ophe+nPAbPoQcBD5A2iC+fjcZvtnamDwpnpC96hwTvpLcojwdTCK900hXvLZPqj0+biC6
K1hEvPQAir5dNFk9pzlYPoF1Oz4wWuS9BrsOPqzEUb6xdBs+PFXePUI9NT4MNB2+UY4SPiuPjb38Q+S9sj3zPM4dMzwnlpU9
oMc9vcnPGb6O2Wg+SUThvY9GQ74BYZC999Z+Ps93dT7BEMo9kBySPofYzT3S3ce9HJcivbmUJj0IaKi9vaoUPrajwT2729E9
ETK/veFsJb50jhG+aKAcvu2tAL7d4c89C7gbvnAFCj5eDwi+ifE6uwc6Nr5t3wM+8em2PZJmN77VDi6+LvPcvYeJgb6trUy+
vP5Cvf+fIr5tS3i9HhrsPKy3d74kHRE+sv8jPEcKQD2jRAC+JYLlvfrPE77phUO++oC7vXiph70WmU49pX8LPuu4UT7o+La9
OqQTPfChvL3cG7s86BPdvWHkWb09F7i9W1BqPOaCGb7Pfm++oEoIvvo5Xj4MzBS+M0XLvWfuTz7FSAK+Qo4gvlfxo7tpE2i+
ZDbsOiFhOb01iha9QH8APnNmCz7QLDa+WMbivCqKebyp2sI7/SHAPVZKmrxdWw4+NaYoPNU6/zugcfY9NB4uvqZcQL4lMFO+
0+4svm2g4708QiG+NkXQPWF80DtwEHO7on/3vPDu6j1ITiQ+Qeo6Po/MJT45MYg9gG68PJB+tj1xIL89SRXHPR8+C76yk9S9
gSAiPnZaib6O7x4+F9kfPgUyVL6PCs49f9+SPMnAEj4UDZ299ttlPj28NLxyUvM9H+QXPthXHL5CkU++w7IjPCouxD17ggu8
MbvrPSbNeT7JVUO+Js5mPdQOP715nzu+7qrTvfO1tTxNX8Y7nAyNvVnU8D2P7m29xwYGvUppe77Y4ye+1yr9PRGLEr41vaI9
x2FoPihj872Ntyq+1A8svD++Gb5MIhO+s8U8PbMYjb3ZQJC9ZBtSPizX7r14PbA9x/MwvswkOT6NPJK9XITBPS5cVj25kjE+
Lo2BPoW+iz1qO2C+bTpwvTG8qbxysHQ9DUUlPTnVID4U3t49aEY2PjfobD0OPI49lghovfmCgD31hzU+PgcnvqTlHT487V8+
nBrRvSmr+b0h1k8+MOhtPVq45D1EWks85GpVvsEeUz5vGtS9PvT6vdOxmDxVqsu9/t1ZvtbPBD7GWxg+tyBVPuGE+D0Ah+A7
UMwpvoOEAr7Gixo+Uz8fPgg3rD3JeCG9SOM2PmTZpTwi0yS+CD0RvaMyTT1u1iY9gZl0vLGERD7Fb6+83Z+tvU9WUT59LwK9
pzsIPkgGzb3CvSy+U7DovbymEz4n+xS+mugPvjm8CD6owNk7pMVJPXs6tj1BMV080CcFvoGITT4XM+I8XPSnvWUFVj4nH8w9
XdPSvKTPCr7XoOm9hJsMPu/oLT6XGTA8Ba6jvMfvGL7NYtm9fiDWPVDoOz6N6Fy+GKREvqgcJ71YPAM+B7QaPSzEI74QgMW9
EuNFvmA1PT7hmS490JVnPZaiUz4DTka91fswvAkMHr0gNBy+KJg/PQMdBr0BVwO+tfhxvUFTU7xlWBO9dJCOPd8ci75hMjy+
o+EmPe/hTj3xQZy8y8ESvr1I0j3hzg0+JetDPo1I0T1FtTM+Ah+JvbkodT2BiZM5D4Ubvh7K0rwOLa+98xnsvfxNTr6NWly+
MVn4PUXerT0/9Q2+HJwEPkeQZb6gWym+KQsgPhP0fD22A4m976DIuQpyJr5uXBK+s5savvQbsr0qIfU9E6n/PDbcLb50LjS+
DGhBvvwinrw2qCc+NKZkPTBkcr2UOmk+eMlBvtmnlz3C5R4+59zgPeg/Az3E3ti9eo9uvodNnz2jSpA5k4MQPu8gz72ZF/c3
T0HlveylN75+1wC+Za/UPdBkKz14UVe+Y7givqklgz6b+AK+MkcQvr3Ip71Ayfe99Zo6vj3w5T3yghw+CG+lvTtwj70HW2K+
YyD+PVP6S75PnAk+X6+2PcDRCz78H2Y8DOfWvQaQpjxXw9y8nnkQvcItvD1f79k8KqDjPOtZyD0gPxK+Av43PRMGmTzS1XO9
ejPbPDimkDzabei938TvPbV73724hH49pwaAvQwFtjx0fYi+ZKZyPmvLAb4BwU6+5XbnvTm7Cb6Jpeg95sIdvlR4oj2eXXE+
IoGDvakMGT5DFsC9nn4MPm8kHj7k5xi+Zq0xvio9vD3Q9dq9a6HfPfCQYbypCXk9SCAsvsPTGbvUxB6+U/5CPgk1670yGGk9
DU1RviB3aL5oW7u9kMkMvkc9MD54AQu+BS3qvPcznj2BCQS+EsCJvQGqGj4P8g69UNeHvcaz3T1VlQg+15mLvVk6Pz2NP+O9
tsEPPnNHFT06PkA9pYNJvlfDIj5OwMS9s+WDPRonyD3J+3I++C8kO3EeQb6CAW09iuvsvRZUzz0s7/A9Gh7tvYsGKj3T5ue9
D6G+PZtePL16UR+++PNaPgrvcb1hQCG+UXSYPRIFWL4tyQO+SPmaPXmYOr4BbjM+2wM3vgPeMT7xeyE8f1SGOtN3ST6QcEO9
kG8YPhjmoj2BFco9M5t1vql+FD3+QPW9e8toO3tsUL4UeEa+V7QRPj2yvzyea4q9w8fVPC0yaD3nFmI+aKjZvGGzqzxdT5y9
iuIMvm7GCT54uv89Pf0Avk3Oir0fpYw9JxDcPJYeSz01VDo+JbaFvYgJOTy1QxY7pxokvWtdeTxeEUS+cmfpvRasX73GrfW9
0PS0vSpGOb1Gq2Y9hFQ5vIGMWz3cGWc96z8ivRBvADvDD1Y9kEBOPY4X1z0uQay9IIpovRUhJ73BARQ+qJEVPpG6rD131Ho9
TYqsvYT6NT5fc9S9TK9XPicUkj2bFlu9O7C9vcuxoD1WK6O9GjEkvsB9cz7iwNI9+xuovSZvpT1o+04+2f6wPeO/F7yfOQ++
K/MmPq6Mirx2DjY+upQlPjRKBD4m+H29oZNAPlCyxz1pfUa+lHjovdweTjwEFu69p6YDPuNSIT4Ppdg96WkNvnFN9D1/7Co9
vOBXPryzar0SJQw+a8VaPoW5N7wM9/096oAoPgSlKT4AbkC+HDw6vD8BPr6E/KI9SeZjvqR2EL6wP5U9Geo3vnbQCT4XOBO+
XGCOvf5N5L2AnVo9EiUxvqYSpj1Yo7u9N0JkvskTPT4usFW+Wrw4vU+eJT7wKwA+xDpdPo1LoD0Jbt+8EqURvqlyKr6L7A6+
V49zvvK4AL4cZAU99dO6vbscpT3knMS9bJwRvr9nxr3ocLk8SLHEPSHlCb1Cfkm9n5sWPP9W4zzp++Q9gyUEvnKX6D3yS688
R6trvp/M4bzvAbE55QaLvaO6BbzZulC9oUg9vDmdMr7Oqn8+BV42PqlQDz6lpxw+A/AUPk/7Ib7naBu9PyP6vbFDjbyhr5e9
wzpWPqrbAL7sFi6+YWU8PiXpIb44rbm8hA2qvR+v9r35VRi+QZ+iuGMxL7zLazC+1e8JPh/B6D0DjwG6mmemvUYFGb4Dj++9
1jdwPnWOsDpZnmu+AUEXPpxqkb2OnVS9d79RPWEXSjxVXTG+SzoYvrMcKb6Oddu9hw7YPS6h7DzIhpu8RDf1vVFB2j3/l7w9
XZk2vg5SkDzfcQA9GC8qvS6OCL1l6O09x8VSPS4Vwjwndcc9XgMWPixvYj582uI9OoKBPIByDT7F4qQ95hlDPEfjv7wDfNU8
FZE2Pqm1yr02qR69bsI/vqnZW75UsKC8BsPxvXMhBL7kvlW+FqifPc34UL5/5Qi+iN5+u10trz1Xkkk+dmvCPHoCBT5Gn1k+
gSsWvdpmEj5U6T++5hhePRm+Fj6l1hI+lUyrvYVxrr1q6Cc+BENPvXha0b3pfrI8vIkKPgW5ND6lu3E9wUv/vcbkEj4QJzU+
dasOvc6kXz3nnio+jmUcvrsFbr3iv668WXDIPQ6vNT5boTQ+7WLGvaZCsb063co9NyACPuKuQjzhZQY+iyaaO4QAxj3jXuC9
FHpJPWjAmz2lMrW8qtVIvmuAID1Ar9m9PWPUvS+1xz0dUza+3+KYvJyTAz7xpoa9rlwSPMs2Sj4J4Do+V6T5vQODKb5yiQ49
ojBAPpgw/zymVHW9+jY6Pg2+PD79VUQ+3NspvMbEzb0310C+fqUbvspjQj7KUU2+l1JCPm1nNT5bxcK9jPSMPfSNO75+TyQ+
r5gEPMOp8z1gCyG+SXlnPIK3DD6i+X89F0IjvDQsojxRVKY8mUrRvI3Xuz3aByc+03lhPbPoAD7wKh0+0stWPTv7871jt0W8
BMa7u+yrD734aea92uo+vVqv5r0CbhA+WwlWvm1cybpKXM29iBaZvbOeRT7DNg0+cqoIvSeosrvwIJy83yIBvnz5yj12xg6+
9OTqPXL9Mj54tto9PW1SvTqcoj1cNSM+qecnPrS/ab6rryY+LO05vrunH7xCyU++5C9fvb4wPb6I6fY8WsdyPaCHDj2Q7TY9
qAnmvU9N9b3sFDK+0B8MPuhiqb29jos8Oo4PvtIV6D0xTsM9K3wqvhkYF74wepY9v6SjPWyGwr0tWLa9uGctPrGSAr5ej8C7
QqfWvG47Dz59Mr094KLiu0AMBT7RqWa+fdH7Pfo6V7403Og8SAYnvQ5OIb5hDny9D8lYPsbslj0lXhS9j3s3vjWSWL7O1kw9
VxmsvFeX4L2PZn49+ElSvjqykj1aSx2+AJdoveFN4r3QLIU+XjemOnhBKL5p4E2+JgXlvJVqQr3Lrhk9ltbcvfjLer5gLg6+
jfafPO9RdT38kp29GTTEvf7lLD0Kl2e9MIAzPoQmDL78PUu+Skgkvlexsr3niyK+o134PRcPA72bOne+loLSvZuPgr3KY0C7
HnQkPmOX8DzkdTU+5ccZPl84Mj1C1gO+9pU5vjYxFb4msY09EPwhPnDl/T0R7U8+d2Rhvi1+jT0o0oq97K9KPt1YwL2F0gK+
3kqnPZ0dKr5RAwK98ZU2vlJDvL17Z5W8Hq7Avf1WDDxu2sE9oC+tvU+XTTzcytc9CW2YvbNV5D3TzQC+41SgPTkVqz0NJge+
wpW1PY9Z6L05uiQ9Po4wvjpoz73RuII80NvNPQHdQj7FvL69VwCrvboYBL4g3D+8nlTVvfHBWT577YE8pvouPpq4HT7G/Ba+
sGO6PaNH6r1uitu88cIdPgT3Az1u8AC+CfH/vfjVx7yxtqm9CJMZvsn2Hj2jG6e9a0FYvjkYOb1jt6Q9KjxpvkdrK70FKXe9
8bl8PmOfm71gsL+9OJRrPV34qr01CDc9VHluPrNsCr5dzDe+XYQ2vn/Qurzcix8+6bETPnS/Dj6Agfk8+j7QPUkodj7xVjK+
YO6avedP4z1yu1k+e0PfPIGWkz3FThQ+FA8hPkAjoL1MYlm9pOAcPtyjRj7GIQs+w/ofvUYxjL1tg5S9EEkoPehQjrwrtTq+
8YHtvTXmer1BTkC+9bUxvW1ohL3eNna+xkQ9PlVIjDt72gI+jKsXvrol3D1unto9oEpxvohQvz2A+Py9Qm1OPrP1wL2/Tfc9
ZAW7vSt8WD2O7IK9wLsZPvwxfr0nnJC8gLpdPnG6AT7uMKy9w+9jvc0rkDxK12i8XichPnlmFb4I2SE+QjgOvg0QZT29USe9
Sy4PPoawUT3TCve877c5vndDYr7fP1i+hD02PqY6Jb6St5k9zDRJPoWCoD1HkLk9XF+sPb1lET6S+Qq9azkqPsSD0r0J6SC+
XOQYvUgijT0lQwM9wtkNvmcHhrpdaC++sy3uvVd+AL1K2IW9oQ48PoJE0T1kfVm+1WM+vo/aJz7GwR68hbY8vuNAk71rirC8
nYARPgD0TT3TYkA+qi5WPnVKMT50KwS+UOYjPuodE7zFoFq+ZEPdvK1uRD6/CdU9nEPEPYViGz15iES+M8bavUqVLL0K5549
DQDwPSfnQz45MRG+FqQ4vHJAaDysGg0+u5iePehq5z3aVCU9x7cVPsqXyT3zhFM9uPIjvWHQ6T3LZkM9pFCqvT9cC77neYU+
A8XXu1LGfTytfKq9Pkx7vuP8F77vFxk+14V+PQmcIz4mjAy9EDYlvmugpL2LPwk+2iAovpwon73oXlY+hMZGPozpFj2VIa27
GVG2vTntLbxmPZi99tAkPj3bcz5kEFG958p+vZyHmb2L14K9K5UrvjNr+r1j64O8on82vWSkaT5Z8aS9MKtPvjBxGzyAeMc8
PqKDvkuVID6Q2Rk9JNi/PTKTHj5LnQy+ukkgPvDAZb6RjvU9Px4Kvu7j8b3zFUO+U05MvmQbDD6l4B0+BCKTPJzEhzz2TSY+
xQ3gvAfTNz6p8D8+xBwvPoPiTz64uam9YXPQPdhhCL67riS+diKNvMc0PL4kyRC9Zm/sPQkCsb0QBza9eclDvqqKSb4PeGC8
yhrJvZxaJb7lbB6+OJQVPmUCP776gj48SruIvNnmzD3BABs+zddivAk6Eb35Zk0+a6mlPfX7az7oiiC+6MwcvvRQJ77CUCw+
p2wbPo/VXD7FBDa9gCRTviU0Iz4NipI8OQLevR8ssr0ohgE+31fGPTJzAT6NfUM8m4K+vXApOj6DNBC+wDwdvgP9zD0HcAk+
96XvvYJdBr4mksA9ceFRvpdTq70l0ly+6aRdvropkb2TEJs9ukqUPRk92D2C09Q9MntSvtJxs720IzS+WDl6PnHfLT4hhMc9
XUCnPXT7mz3bvvq9I5sHvl1IVL6F1l+9WQOgPDZdRj1+mtc9ycgEvttDGD05f8M9SLpHPk45vDywgL291cnHPSvsGD04aAm+
RC0HPgoy1T1B2dO9dWwCvmcojD2mmjQ8obQVPcP2Jz3tt989C0ACPfCmML0/rDO+aXepPWtHBj3M4lu9m9xpvh74VT5a5LY8
G00fPre6iD1WsSa9GeACvkm+97wZnSS+dGoDPugfFj6jUAA+W3tJPu/FkL3yO649XeQpvsoUML7Th9M92a42PotrVL2oRz68
15revVuuZb1x5EW+qkK1vTM0yjxeGte9XPjCPMsmyzw8JU8+hen8vRgcO77jcGG+5cmoPaDr2j3kNwS+tmFlvjrwpj3yCNq9
q1kGvrl2Iz7IwQC+zNDvvYEgAb2ho769iMGfPBXNHTwzvBC9yQEvPoTaOz5TYyG9Qph2Pv+bQL7TowY+xaulveqggT7r/A49
y2sDPq0cXLz8ODW+fnCFvV9gBL7cDao8nXzjvaLlCzuHrz8+VHy7vQA0Pj5WUXg+b7tRvFUiGj0mkyi++UIfPYiSiz3+ktC9
ZyfZvRg/Tj5+S2M+erruvHjJJT4/z929k7pVPnABbDzGGFY9Fj7MvZ1zUr3aTsq9wS3kPP5fkb0rYZU9CMvkvchbCz6mVsC7
jj0LPXVsxDx0vrs8fqAYvqEI7L2Izqg8xWjNPTAqar4Hira9qwXGvVfmQb7aFQC+wpk8PiQ0B74ljus9Sn9rPvXO8D2vjQY+
jUK0vXb4wz1l+TY++WE6vj4ugL3jzIQ9YT7QvQejUj7B9wY9kgQxPpUf3z2+72K+xffWPTJ/qryYNRc+SBn0vZFdKT5HLQs+
bJTrPchAKz73G6k8oCELPt7ADr6nWFw8jwZgvvNoKr6PkEU+KT8nvt2orbur3xo+RugVvWN+Lb4a1Ag+CJ5iPrPjGb4EuH+9
aGo2Pmyo8z0ITDc+xkIlvYwklz2zcwC+sgxrPqgxXb7bEOo97ACGvUZ0Sb2wuQi+DW9vvd0ubL2A0tA9m939vYA027w8ts69
ykcoPSMHNb5/9Qm8TEx6vi67Hr4tiZq9utv7PR1fQD5uWW69jdXCvac58L1T0LA9fLAvPqSJML1sDd89gIsYPjlu2D1AwxW9
r6PxPeLjCz494Ac+trElPhxFPb6jrRI97Y0zPf1Q8jzmz/O9Aog1PqBp6TxsEF8+uJFGPqnuVj2wuSK8t5vbvbIaUr7dHpw9
6a2lvQBul7xYcJA9X5C3vbJ25r3fIr28UbMDPqymSryLfJa96kITvughPL3S6Aq++6IPPgeL1Lzw60g8w1ZgvSd93r2Nt569
7dXhPQg9nT3HqEY+68E/vosdkDxmqSa9tCRrPvTBnD2y8xE+ZYYZvkftNr2MikS+8R4gPpFihL3JdjY+r2COPTJzc73pOE09
5NopvI0vB74OvwG+9bUIPXPZPT4hAqw9r3qwPetD7b0+EE++lqK5PCVBH7502FM9r43FPTXCzj2m3kW8Z4MoPNrI6L3d4kM+
Y1yrvd3WSzwZfA88ZAk/vuyMOTyctik+IHUIvQS7CD3snkY+EVlTvn8gLbvKFSW8vZHGvZSzub3FW7O9un4SvhS3QT5eKL+8
kKghvJ/DMr4YP728cO8jPinlWL6NQ0K+9VxUPuhxBj4gAx2+ekvhvZIqIj2utZi9QNMovoRgOb6qpy6+/rOqOzPZBb7qsp+8
n4RkPvCbdz7wN7+9xTg5PiDlYr5jyTI+5lklPkBHNr3nN/i9kIGjPRp/UD2t7gw+wlVSvdIL+T0B7u49h5B8PoVLLr1sefG9
ER+mvWMfGD6Tlew9iXAavvcfvT28Wfw9AlQlvjanEz793p89VVecvR1GjL2ObVS+2L43PnU6oT2L5wG+iNuLuxh0ar2msJ+8
6Xi+vXpMdz5gM389ZsVVvvrc2D2d/xG+BLhWPvOlMz4Utyk+cuDZvSiHjL1yxDa9ZnyDvHHNxLzocZ29OdDJPY5edj3a1l48
e7E8vtOfAr4AfTy+TmCRvTTvHz3KIlM+fdz3vcgaLz4MIbk9/hQaPXFJjL47L1m+jfELvWcmlLxfxL68QE9CPRDDG772PsQ9
k/MYu9Y9O77fVTC+YLt8vZHW4r1w41o+kCuOvZKPxTyIoSe++sDBPZjKNbofY+29SOgsvQIVD75UzzA+N1v/PTzXtL1mVim+
uQpvvZcbJzrzMhQ+y5/6vFb2kr3/a2Q+L59xvg4KCz7Cjg69f/ZOvuUfeL5kUgO+zrKiPThWhb3Dge29faS5PJomUr5FqTw+
FOUvPlPuv71u2RW9c/oTvt9lcz4vW+88E5sePmJfDb6Fwzq+bfoKvgSPij0pbyu+xdCoPb5c3j3KVU2+9NF6vQC4FD5QBMC9
N/qjPQ4PMz70iaA9T6IyPiY1S7627Dm+8pPtPUxNUD6pyye+7jj0PUj4Sr6nV0w+4GwiPnx8UT7rVd07pZIAvWijzL1jLIM9
ZsRUvvqiTD0TRK49IuDvvNd+J76MaB++sq8/vi7ncrxUlgM+n4OUPUwTHr7lIHW9KjB5vFYrUL5Jpfa9eqQcPVJMjDwXHnW+
eIpXvYrpnb01Lv89qWVbPnsboLszjek9sZnCPVJ5xz02UEI9YFKbO77X7r03t4y91pQgPoqbgz0ItCq+fICivaYqSz6byw6+
OmDBvSaMuj0hr2s81m9FPmdzFD7uIQ2+hn0pPr/8YL45zCa+bbxAPsABCj7yGA4+OQ9evveTcT4v1Sc+FuhCPAMWAr6IpFW+
Jk4MPYCQpLr4Jb+9ZONwPjRGAz6zdJo9ciAsPQdAKj54lo29CuptviA2HjzxHxu+UId1vrGNXr2Nvhk+VWVDvv5OAD7tuB4+
LNY1Pt6A4L2HE/69XKsKPqLgjj39jqu7CPTCvfgLKT5OdzU+6jxfPv3Wlb3Zlx++ve7fvREGer7YOFk+7LnJveK73z28t2s9
O7lEPuYrlT2A/Nc9lUZ5PFFaGb7LQA++FXw0vvpUbbzBVZ49Wew+vh2Ezj0Db/q9cnchOdqVsD0XZES+FOGvvdIYOD6QeES+
W+1RvaVK5r3UWni8SuysPPS+sL3NizK6vzU6vopnBD6e60q+6do2veHUL75SHB4+KIRnvtrY2b2PatW9BV5QPhhdQ76luCI8
++cCvoNWOr70XU0+DMzbPGthHL4pSMs9ojEcvpYoFT4Ns3E+f4/vPYz/4T280K291yP0PN5Rnj2j/3E+84Zhvq+eJ75s6RI+
VqoXPpYGOD1e91a729s6vv2elr2f/v89LSylPVRCHr523PK9LGsXvnzvMj6Pm7e9bgM2Pk/QOj5bsQI+hLxjvNqsyj1pJfa9
nDEhPIkeOz5Ur9S9k9PCPIfFOr7gLHS8YYEgvmrKaD4xNQ89khlSveOQJb7NAxw+JTFQPsH2arziyXK+jecevrpvqz2U8RI9
rh5kPo6JLbwo6gk+2OQhvb2Fmj36H9280/x3vfzuaL6SxyE+gNx3PcNcLL7FmqW90lC8vNmoD73QIHK+cOw/vrLOwz25tCa+
r/HovU8TUr5+dtm7KsojvhXQ7j1NASM+BpClPBxHuD3J+yu9/twaPv0oWb7/A00+N+1QvhYhnzzjQ4E8V3givdG0Y7wy+I8+
mPh0PaD/IjvLjyG+hKdgPsD+o76hfIm8dnTyvYAj2j1QL3c9OqgJPYt2nL7JBCC9pyTtvVlCOL5JFAU+Dep/Pum9yD2emRK+
rPpCvtOqH74cyns+Qb1Evsrc/r1Opb49uaKOvj/Zkz3AHle+RIbAve37FT7FlSW+x4pOvRw2AT6MZYs+nfTCvYDtXT27HGI+
8IBkPhxVbj4msTG+sm4zvprEGT7/CTY+RZ4rPVVw5L04pUa+MY4ZvinsVb4o4lo9Ilg9PlrHDb6Qw9A9mWfMvFXuZb6EODG+
u6C2PBBGcj6ecGg97r1nvlmKfD3x0Ac+OO0YvWum1D0pnFi+HbAPvlTUVT547dU9fVEhve+eBD7/hBK8AdvcvWA8Db6vn1k+
RU0BvgzBYD0h3lu+FNXrvUpZQj5pKVa972rlPE/QVL54bzg+Jl5Bvlabbj6ksGi+oWbKvVZ+Nj60U0A+ODB+PRmaRr5IqJQ8
sz0GPr4a6L0OoIu+posNPmJZGL0wCL09CEgBvhgpcr0T1ZY9FyAmPgNWu70T1ty96Lv6PeW5+bwXoJu9h03gvYyaFL5y8Tm+
+OFivtd0L75Pyq093WDQPcFQ6b2jTTs9kMNNPtmzMD7tWk6+npzivYSjPT7PoMw9HvAbPqm0Ab6WYCs+9rBAPmrD6b1rqiW6
CeXYu9wvHT4I+uO8TSRjvTtkPL7TH528D10MPoJ4VL4PQQ4+mhbDvVAUcD40Gye+XveEvoJDTT0cv1W+HTK3vfFBcb056lS+
PI2ZPTtXHD31zbO9Rh0UvpS1R74l+ve98bkDviJMRb6yGh0+IS9BvA==
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
