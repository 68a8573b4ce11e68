"""Skeletons as tools name them. Each line is a chain of joints, hung below the joint before the colon; a name may have a role.

{S} is Left and Right, {s} left and right, {L} L and R, {l} l and r, {J} the Japanese sides; "~" is a space. The letters behind
"=" are those of ROLES. A joint without a letter carries no limb.
"""

from __future__ import annotations

ROLES = {"h": "hips", "s": "spine", "n": "neck", "H": "head", "c": "clavicle", "a": "arm", "f": "forearm", "w": "hand",
         "t": "thigh", "k": "shin", "o": "foot", "e": "toe", "j": "hip joint"}  # fmt: skip
SIDES = {"left": {"S": "Left", "s": "left", "L": "L", "l": "l", "J": "左", "G": "LEFT"},
         "right": {"S": "Right", "s": "right", "L": "R", "l": "r", "J": "右", "G": "RIGHT"}}  # fmt: skip

HUMAN_IK = """
Hips=h Spine=s Spine1=s Spine2=s Neck=n Head=H HeadTop_End
Spine2: {S}Shoulder=c {S}Arm=a {S}ForeArm=f {S}Hand=w {S}HandIndex1 {S}HandIndex2
{S}Hand: {S}HandThumb1
Hips: {S}UpLeg=t {S}Leg=k {S}Foot=o {S}ToeBase=e {S}Toe_End
"""


def _changed(text: str, name) -> str:
    """Rename all joints of a skeleton."""
    plain = [[(w, w.split("=")[0].rstrip(":")) for w in line.split()] for line in text.splitlines()]
    return "\n".join(" ".join(w.replace(p, name(p), 1) for w, p in line) for line in plain)


def _numbered(text: str) -> str:
    """Append what Sketchfab's conversion appends: one number more for each joint, _01 and on."""
    seen: dict[str, int] = {}
    return _changed(text, lambda p: f"{p}_0{seen.setdefault(p, len(seen) + 1)}")


SKELETONS = {
    "CMU, .asf": """
root=h lowerback=s upperback=s thorax=s lowerneck=n upperneck=n head=H
thorax: {l}clavicle=c {l}humerus=a {l}radius=f {l}wrist=w {l}hand {l}fingers
{l}wrist: {l}thumb
root: {l}hipjoint=j {l}femur=t {l}tibia=k {l}foot=o {l}toes=e
""",
    "CMU, .bvh": """
Hips=h LowerBack=s Spine=s Spine1=s Neck=n Neck1=n Head=H
Spine1: {S}Shoulder=c {S}Arm=a {S}ForeArm=f {S}Hand=w {S}FingerBase {S}HandIndex1
{S}Hand: {L}Thumb
Hips: {L}HipJoint=j {S}UpLeg=t {S}Leg=k {S}Foot=o {S}ToeBase=e
""",
    "MotionBuilder's example of CMU's .bvh": """
Hips=h Chest=s Neck=n Head=H
Chest: {S}Collar=c {S}Shoulder=a {S}Elbow=f {S}Wrist=w
Hips: {S}Hip=t {S}Knee=k {S}Ankle=o
""",
    "Mixamo": _changed(HUMAN_IK, lambda p: f"mixamorig:{p}"),
    "Mixamo, second character": _changed(HUMAN_IK, lambda p: f"mixamorig5:{p}"),
    "Mixamo in three.js": _changed(HUMAN_IK, lambda p: f"mixamorig{p}"),
    "Mixamo without a prefix": HUMAN_IK,
    "Mixamo through Sketchfab": "_rootJoint\n_rootJoint: " + _numbered(_changed(HUMAN_IK, lambda p: f"mixamorig:{p}")).strip(),
    "Ready Player Me": HUMAN_IK + "Head: {S}Eye\n",
    "Maya HumanIK": "Character1_Reference\nCharacter1_Reference: "
    + _changed(HUMAN_IK, lambda p: f"Character1_{p}").strip()
    + "\nCharacter1_{S}ForeArm: Character1_{S}ForeArmRoll\nCharacter1_{S}UpLeg: Character1_{S}UpLegRoll\n",
    "Maya Quick Rig": _changed(HUMAN_IK, lambda p: f"QuickRigCharacter_{p}"),
    "Maya namespace": _changed(HUMAN_IK, lambda p: f"hero:rig:{p}"),
    "Maya path": _changed(HUMAN_IK, lambda p: f"Armature|{p}"),
    "Blender's numbering": _changed(HUMAN_IK, lambda p: f"{p}.001"),
    "a studio's prefix": _changed(HUMAN_IK, lambda p: f"Hero_{p}"),
    "a studio's suffix": _changed(HUMAN_IK, lambda p: f"{p}_bind"),
    "Maya, _jnt": """
hips_jnt=h spine1_jnt=s spine2_jnt=s spine3_jnt=s neck_jnt=n head_jnt=H jaw_jnt
spine3_jnt: {l}_clavicle_jnt=c {l}_upperArm_jnt=a {l}_foreArm_jnt=f {l}_hand_jnt=w {l}_index1_jnt
{l}_upperArm_jnt: {l}_upperArmTwist1_jnt
hips_jnt: {l}_upLeg_jnt=t {l}_leg_jnt=k {l}_foot_jnt=o {l}_toe_jnt=e
""",
    "Maya, _bind and _jnt mixed": """
root_bind pelvis_bind=h spine01_bind=s spine02_bind=s spine03_jnt=s neck_bind=n head_bind=H
spine03_jnt: {l}_shoulder_bind=c {l}_upArm_jnt=a {l}_foreArm_jnt=f {l}_hand_bind=w {l}_index1_bind
pelvis_bind: {l}_upLeg_bind=t {l}_lowLeg_jnt=k {l}_foot_bind=o {l}_toe_bind=e {l}_toe1_jnt
""",
    "Advanced Skeleton": """
Root_M=h RootPart1_M=s Spine1_M=s Spine1Part1_M=s Chest_M=s Neck_M=n NeckPart1_M=n Head_M=H HeadEnd_M
Chest_M: Scapula_{L}=c Shoulder_{L}=a ShoulderPart1_{L} Elbow_{L}=f ElbowPart1_{L} Wrist_{L}=w MiddleFinger1_{L}
Root_M: Hip_{L}=t HipPart1_{L} Knee_{L}=k Ankle_{L}=o Toes_{L}=e ToesEnd_{L}
""",
    "mGear": """
root_C0_0_jnt spine_C0_pelvis_jnt=h spine_C0_01_jnt=s spine_C0_02_jnt=s spine_C0_03_jnt=s neck_C0_01_jnt=n neck_C0_head_jnt=H
neck_C0_head_jnt: headBendJaw_C0_0_jnt jaw_C0_0_jnt
spine_C0_03_jnt: shoulder_{L}0_0_jnt=c arm_{L}0_upperarm_jnt=a arm_{L}0_lowerarm_jnt=f arm_{L}0_hand_jnt=w finger_{L}0_0_jnt
spine_C0_pelvis_jnt: leg_{L}0_thigh_jnt=t leg_{L}0_calf_jnt=k leg_{L}0_foot_jnt=o foot_{L}0_ball_jnt=e
root_C0_0_jnt: ik_foot_root_C0_0_jnt ik_foot_{L}0_0_jnt
root_C0_0_jnt: ik_hand_{L}0_0_jnt
""",
    "OptiTrack": """
Hip=h Ab=s Chest=s Neck=n Head=H
Chest: {L}Shoulder=c {L}UArm=a {L}FArm=f {L}Hand=w {L}Index1
Hip: {L}Thigh=t {L}Shin=k {L}Foot=o {L}Toe=e
""",
    "Motive, with the skeleton's name": """
Skeleton~001_Hip=h Skeleton~001_Ab=s Skeleton~001_Chest=s Skeleton~001_Neck=n Skeleton~001_Head=H
Skeleton~001_Chest: Skeleton~001_{L}Shoulder=c Skeleton~001_{L}UArm=a Skeleton~001_{L}FArm=f Skeleton~001_{L}Hand=w
Skeleton~001_Hip: Skeleton~001_{L}Thigh=t Skeleton~001_{L}Shin=k Skeleton~001_{L}Foot=o Skeleton~001_{L}Toe=e
""",
    "Daz Genesis 1, 2": """
hip=h abdomen=s abdomen2=s chest=s neck=n head=H
hip: pelvis {l}Thigh=t {l}Shin=k {l}Foot=o {l}Toe=e {l}BigToe
{l}Toe: {l}SmallToe1
chest: {l}Collar=c {l}Shldr=a {l}ForeArm=f {l}Hand=w {l}Carpal1 {l}Index1
head: {l}Eye
""",
    "Daz Genesis 3, 8": """
hip=h pelvis {l}ThighBend=t {l}ThighTwist {l}Shin=k {l}Foot=o {l}Metatarsals {l}Toe=e {l}BigToe
hip: abdomenLower=s abdomenUpper=s chestLower=s chestUpper=s neckLower=n neckUpper=n head=H upperTeeth
head: lowerJaw tongue01
chestUpper: {l}Collar=c {l}ShldrBend=a {l}ShldrTwist {l}ForearmBend=f {l}ForearmTwist {l}Hand=w {l}Carpal1 {l}Index1
chestLower: {l}Pectoral
{l}Hand: {l}Thumb1
""",
    "Daz Genesis 9": """
hip=h pelvis {l}_thigh=t {l}_thightwist1
{l}_thigh: {l}_shin=k {l}_foot=o {l}_metatarsal {l}_toes=e {l}_bigtoe1
hip: spine1=s spine2=s spine3=s spine4=s neck1=n neck2=n head=H lowerjaw
spine4: {l}_shoulder=c {l}_upperarm=a {l}_upperarmtwist1
{l}_upperarm: {l}_forearm=f {l}_forearmtwist1
{l}_forearm: {l}_hand=w {l}_indexmetacarpal {l}_index1
spine4: {l}_pectoral
""",
    "Poser": """
hip=h abdomen=s chest=s neck=n head=H
chest: {l}Collar=c {l}Shldr=a {l}ForeArm=f {l}Hand=w {l}Thumb1
hip: {l}Buttock=j {l}Thigh=t {l}Shin=k {l}Foot=o
head: {s}Eye
""",
    "Blender's meta-rig": """
spine=h spine.001=s spine.002=s spine.003=s spine.004=n spine.005=n spine.006=H face nose nose.001
face: jaw chin
face: tongue tongue.001
spine: pelvis.{L}
spine: thigh.{L}=t shin.{L}=k foot.{L}=o toe.{L}=e
foot.{L}: heel.02.{L}
spine.003: shoulder.{L}=c upper_arm.{L}=a forearm.{L}=f hand.{L}=w palm.01.{L} f_index.01.{L} f_index.02.{L}
spine.003: breast.{L}
""",
    "Rigify": """
root DEF-spine=h DEF-spine.001=s DEF-spine.002=s DEF-spine.003=s DEF-spine.004=n DEF-spine.005=n DEF-spine.006=H DEF-jaw
DEF-spine: DEF-pelvis.{L}
DEF-spine: DEF-thigh.{L}=t DEF-thigh.{L}.001 DEF-shin.{L}=k DEF-shin.{L}.001 DEF-foot.{L}=o DEF-toe.{L}=e
DEF-spine.003: DEF-shoulder.{L}=c DEF-upper_arm.{L}=a DEF-upper_arm.{L}.001 DEF-forearm.{L}=f DEF-forearm.{L}.001 DEF-hand.{L}=w
DEF-hand.{L}: DEF-palm.01.{L} DEF-f_index.01.{L}
DEF-spine.003: DEF-breast.{L}
root: MCH-foot_ik.parent.{L} foot_ik.{L}
""",
    "Rigify, original bones": """
ORG-spine=h ORG-spine.001=s ORG-spine.002=s ORG-spine.003=s ORG-spine.004=n ORG-spine.006=H
ORG-spine: ORG-thigh.{L}=t ORG-shin.{L}=k ORG-foot.{L}=o ORG-toe.{L}=e
ORG-spine.003: ORG-shoulder.{L}=c ORG-upper_arm.{L}=a ORG-forearm.{L}=f ORG-hand.{L}=w
""",
    "Auto-Rig Pro": """
root.x=h spine_01.x=s spine_02.x=s spine_03.x=s neck.x=n head.x=H c_jawbone.x
spine_03.x: shoulder.{l}=c c_arm_twist_offset.{l} arm_stretch.{l}=a forearm_stretch.{l}=f forearm_twist.{l} hand.{l}=w
hand.{l}: c_index1_base.{l} index1.{l}
root.x: thigh_twist.{l} thigh_stretch.{l}=t leg_stretch.{l}=k leg_twist.{l}
leg_stretch.{l}: foot.{l}=o toes_01.{l}=e
""",
    "MMD": """
全ての親 センター グルーブ 腰=h 上半身=s 上半身2=s 首=n 頭=H 両目
頭: {J}目
上半身2: {J}肩P {J}肩=c {J}肩C {J}腕=a {J}腕捩 {J}ひじ=f {J}手捩 {J}手首=w {J}人指１ {J}人指２
{J}腕: {J}腕捩1
腰: 下半身 {J}足=t {J}ひざ=k {J}足首=o {J}つま先=e
下半身: {J}足D {J}ひざD {J}足首D {J}足先EX
全ての親: {J}足IK親 {J}足ＩＫ {J}つま先ＩＫ
""",
    "MMD, simple": """
センター=h 上半身=s 首=n 頭=H
上半身: {J}肩=c {J}腕=a {J}ひじ=f {J}手首=w
センター: 下半身 {J}足=t {J}ひざ=k {J}足首=o
""",
    "MMD in Blender": """
センター=h 上半身=s 上半身2=s 首=n 頭=H
上半身2: 肩.{L}=c 腕.{L}=a 腕捩.{L} ひじ.{L}=f 手捩.{L} 手首.{L}=w 親指０.{L}
センター: 下半身 足.{L}=t ひざ.{L}=k 足首.{L}=o つま先.{L}=e
""",
    "MMD, English": """
master center=h upper~body=s upper~body2=s neck=n head=H eyes
upper~body2: shoulder_{L}=c arm_{L}=a arm~twist_{L} elbow_{L}=f wrist~twist_{L} wrist_{L}=w fore1_{L}
center: lower~body leg_{L}=t knee_{L}=k ankle_{L}=o toe_{L}=e
master: leg~IK_{L} toe~IK_{L}
""",
    "Xsens MVN": """
Pelvis=h L5=s L3=s T12=s T8=s Neck=n Head=H
T8: {S}Shoulder=c {S}UpperArm=a {S}ForeArm=f {S}Hand=w
Pelvis: {S}UpperLeg=t {S}LowerLeg=k {S}Foot=o {S}Toe=e
""",
    "Xsens MVN, .bvh": """
Hips=h Chest=s Chest2=s Chest3=s Chest4=s Neck=n Head=H
Chest4: {S}Collar=c {S}Shoulder=a {S}Elbow=f {S}Wrist=w
Hips: {S}Hip=t {S}Knee=k {S}Ankle=o {S}Toe=e
""",
    "VRoid": """
Root J_Bip_C_Hips=h J_Bip_C_Spine=s J_Bip_C_Chest=s J_Bip_C_UpperChest=s J_Bip_C_Neck=n J_Bip_C_Head=H J_Adj_{L}_FaceEye
J_Bip_C_Head: J_Sec_Hair1_01 J_Sec_Hair2_01
J_Bip_C_UpperChest: J_Bip_{L}_Shoulder=c J_Bip_{L}_UpperArm=a J_Bip_{L}_LowerArm=f J_Bip_{L}_Hand=w J_Bip_{L}_Index1
J_Bip_C_Hips: J_Bip_{L}_UpperLeg=t J_Bip_{L}_LowerLeg=k J_Bip_{L}_Foot=o J_Bip_{L}_ToeBase=e
J_Bip_C_UpperChest: J_Sec_{L}_Bust1
""",
    "VRM humanoid": """
hips=h spine=s chest=s upperChest=s neck=n head=H jaw
upperChest: {s}Shoulder=c {s}UpperArm=a {s}LowerArm=f {s}Hand=w {s}IndexProximal {s}IndexIntermediate {s}IndexDistal
hips: {s}UpperLeg=t {s}LowerLeg=k {s}Foot=o {s}Toes=e
""",
    "Unreal 4 mannequin": """
root pelvis=h spine_01=s spine_02=s spine_03=s neck_01=n head=H
spine_03: clavicle_{l}=c upperarm_{l}=a upperarm_twist_01_{l}
upperarm_{l}: lowerarm_{l}=f lowerarm_twist_01_{l}
lowerarm_{l}: hand_{l}=w index_01_{l} index_02_{l}
pelvis: thigh_{l}=t thigh_twist_01_{l}
thigh_{l}: calf_{l}=k calf_twist_01_{l}
calf_{l}: foot_{l}=o ball_{l}=e
root: ik_foot_root ik_foot_{l}
root: ik_hand_root ik_hand_gun ik_hand_{l}
""",
    "Unreal 5 mannequin, MetaHuman, Fortnite": """
root pelvis=h spine_01=s spine_02=s spine_03=s spine_04=s spine_05=s neck_01=n neck_02=n head=H FACIAL_C_Jaw
spine_05: clavicle_{l}=c clavicle_out_{l}
clavicle_{l}: upperarm_{l}=a upperarm_twist_01_{l} upperarm_bicep_{l}
upperarm_{l}: lowerarm_{l}=f lowerarm_correctiveRoot_{l}
lowerarm_{l}: hand_{l}=w index_metacarpal_{l} index_01_{l}
pelvis: thigh_{l}=t thigh_twistCor_01_{l}
thigh_{l}: calf_{l}=k foot_{l}=o ball_{l}=e bigtoe_01_{l}
root: ik_foot_root ik_foot_{l}
""",
    "3ds Max Biped": """
Bip01 Bip01~Pelvis=h Bip01~Spine=s Bip01~Spine1=s Bip01~Spine2=s Bip01~Neck=n Bip01~Head=H Bip01~HeadNub
Bip01~Neck: Bip01~{L}~Clavicle=c Bip01~{L}~UpperArm=a Bip01~{L}~Forearm=f Bip01~{L}~Hand=w Bip01~{L}~Finger0 Bip01~{L}~Finger01
Bip01~{L}~Hand: Bip01~{L}~Finger1 Bip01~{L}~Finger1Nub
Bip01~Pelvis: Bip01~{L}~Thigh=t Bip01~{L}~Calf=k Bip01~{L}~Foot=o Bip01~{L}~Toe0=e Bip01~{L}~Toe0Nub
""",
    "3ds Max Biped, legs on the spine": """
Bip001 Bip001~Pelvis=h Bip001~Spine=s Bip001~Spine1=s Bip001~Neck=n Bip001~Head=H
Bip001~Spine1: Bip001~{L}~Clavicle=c Bip001~{L}~UpperArm=a Bip001~{L}~Forearm=f Bip001~{L}~Hand=w
Bip001~Spine: Bip001~{L}~Thigh=t Bip001~{L}~Calf=k Bip001~{L}~Foot=o Bip001~{L}~Toe0=e
""",
    "3ds Max CAT, Base Human": """
Base~HumanPelvis=h Base~HumanSpine1=s Base~HumanSpine2=s Base~HumanRibcage=s Base~HumanNeck=n Base~HumanHead=H
Base~HumanRibcage: Base~Human{L}ArmCollarbone=c Base~Human{L}ArmUpperarm=a Base~Human{L}ArmForearm=f Base~Human{L}ArmPalm=w
Base~Human{L}ArmPalm: Base~Human{L}ArmDigit11
Base~HumanPelvis: Base~Human{L}LegThigh=t Base~Human{L}LegCalf=k Base~Human{L}LegAnkle=o Base~Human{L}LegDigit11
""",
    "3ds Max CAT": """
CATRigHub001=h CATRigSpine1=s CATRigSpine2=s CATRigHub002=s CATRigNeck=n CATRigHead=H
CATRigHub002: CATRig{L}ArmCollarbone=c CATRig{L}Arm1=a CATRig{L}Arm2=f CATRig{L}ArmPalm=w CATRig{L}ArmDigit11
CATRigHub001: CATRig{L}Leg1=t CATRig{L}Leg2=k CATRig{L}LegAnkle=o
""",
    "Character Creator, iClone, AccuRIG": """
CC_Base_BoneRoot CC_Base_Hip=h CC_Base_Waist=s CC_Base_Spine01=s CC_Base_Spine02=s CC_Base_NeckTwist01=n
CC_Base_NeckTwist01: CC_Base_NeckTwist02=n CC_Base_Head=H
CC_Base_Head: CC_Base_FacialBone CC_Base_JawRoot CC_Base_Tongue01
CC_Base_FacialBone: CC_Base_{L}_Eye
CC_Base_Hip: CC_Base_Pelvis CC_Base_{L}_Thigh=t CC_Base_{L}_ThighTwist01 CC_Base_{L}_ThighTwist02
CC_Base_{L}_Thigh: CC_Base_{L}_Calf=k CC_Base_{L}_CalfTwist01
CC_Base_{L}_Calf: CC_Base_{L}_KneeShareBone
CC_Base_{L}_Calf: CC_Base_{L}_Foot=o CC_Base_{L}_ToeBaseShareBone
CC_Base_{L}_Foot: CC_Base_{L}_ToeBase=e CC_Base_{L}_BigToe1
CC_Base_{L}_ToeBase: CC_Base_{L}_IndexToe1
CC_Base_Spine02: CC_Base_{L}_Clavicle=c CC_Base_{L}_Upperarm=a CC_Base_{L}_UpperarmTwist01
CC_Base_{L}_Upperarm: CC_Base_{L}_ElbowShareBone
CC_Base_{L}_Upperarm: CC_Base_{L}_Forearm=f CC_Base_{L}_ForearmTwist01
CC_Base_{L}_Forearm: CC_Base_{L}_Hand=w CC_Base_{L}_Mid1
CC_Base_Spine02: CC_Base_{L}_RibsTwist CC_Base_{L}_Breast
""",
    "ActorCore motions": """
RL_BoneRoot Hip=h Waist=s Spine01=s Spine02=s NeckTwist01=n NeckTwist02=n Head=H JawRoot
Hip: Pelvis {L}_Thigh=t {L}_Calf=k {L}_Foot=o {L}_ToeBase=e
{L}_Thigh: {L}_ThighTwist01
Spine02: {L}_Clavicle=c {L}_Upperarm=a {L}_Forearm=f {L}_Hand=w {L}_Mid1
{L}_Upperarm: {L}_UpperarmTwist01
""",
    "Rokoko Newton": """
root hips=h spine1=s spine2=s spine3=s spine4=s neck=n head=H
spine4: {s}Shoulder=c {s}Arm=a {s}ForeArm=f {s}Hand=w {s}Finger1Proximal
hips: {s}Thigh=t {s}Shin=k {s}Foot=o {s}Toe=e {s}ToeTip
""",
    "Rokoko, LAFAN1": """
Hips=h Spine=s Spine1=s Spine2=s Neck=n Head=H
Spine2: {S}Shoulder=c {S}Arm=a {S}ForeArm=f {S}Hand=w
Hips: {S}UpLeg=t {S}Leg=k {S}Foot=o {S}Toe=e
""",
    "SOMA, SEED": """
Root Hips=h Spine1=s Spine2=s Chest=s Neck1=n Neck2=n Head=H HeadEnd
Head: Jaw
Chest: {S}Shoulder=c {S}Arm=a {S}ForeArm=f {S}Hand=w {S}HandThumb1 {S}HandThumbEnd
Hips: {S}Leg=t {S}Shin=k {S}Foot=o {S}ToeBase=e {S}ToeEnd
""",
    "Bandai-Namco": """
joint_Root Hips=h Spine=s Chest=s Neck=n Head=H
Chest: Shoulder_{L}=c UpperArm_{L}=a LowerArm_{L}=f Hand_{L}=w
Hips: UpperLeg_{L}=t LowerLeg_{L}=k Foot_{L}=o Toes_{L}=e
""",
    "SMPL, AIST++": """
pelvis=h spine1=s spine2=s spine3=s neck=n head=H
spine3: {s}_collar=c {s}_shoulder=a {s}_elbow=f {s}_wrist=w {s}_hand
pelvis: {s}_hip=t {s}_knee=k {s}_ankle=o {s}_foot=e
""",
    "SMPL-X in Blender": """
root pelvis=h spine1=s spine2=s spine3=s neck=n head=H jaw
head: {s}_eye_smplhf
spine3: {s}_collar=c {s}_shoulder=a {s}_elbow=f {s}_wrist=w {s}_index1 {s}_index2
pelvis: {s}_hip=t {s}_knee=k {s}_ankle=o {s}_foot=e
""",
    "SMPL in Maya": """
m_avg_root m_avg_Pelvis=h m_avg_Spine1=s m_avg_Spine2=s m_avg_Spine3=s m_avg_Neck=n m_avg_Head=H
m_avg_Spine3: m_avg_{L}_Collar=c m_avg_{L}_Shoulder=a m_avg_{L}_Elbow=f m_avg_{L}_Wrist=w m_avg_{L}_Hand
m_avg_Pelvis: m_avg_{L}_Hip=t m_avg_{L}_Knee=k m_avg_{L}_Ankle=o m_avg_{L}_Foot=e
""",
    "Kinect": """
SpineBase=h SpineMid=s SpineShoulder=s Neck=n Head=H
SpineShoulder: Shoulder{S}=a Elbow{S}=f Wrist{S}=w Hand{S} HandTip{S}
Wrist{S}: Thumb{S}
SpineBase: Hip{S}=t Knee{S}=k Ankle{S}=o Foot{S}=e
""",
    "Azure Kinect": """
PELVIS=h SPINE_NAVEL=s SPINE_CHEST=s NECK=n HEAD=H NOSE
HEAD: EYE_{G}
SPINE_CHEST: CLAVICLE_{G}=c SHOULDER_{G}=a ELBOW_{G}=f WRIST_{G}=w HAND_{G} HANDTIP_{G}
PELVIS: HIP_{G}=t KNEE_{G}=k ANKLE_{G}=o FOOT_{G}=e
""",
    "OpenPose": """
MidHip=h Neck=n Nose=H
Nose: {L}Eye {L}Ear
Neck: {L}Shoulder=a {L}Elbow=f {L}Wrist=w
MidHip: {L}Hip=t {L}Knee=k {L}Ankle=o {L}BigToe=e {L}SmallToe
{L}Ankle: {L}Heel
""",
    "Perception Neuron": """
Hips=h Spine=s Spine1=s Spine2=s Neck=n Neck1=n Head=H
Spine2: {S}Shoulder=c {S}Arm=a {S}ForeArm=f {S}Hand=w {S}InHandIndex {S}HandIndex1
Hips: {S}UpLeg=t {S}Leg=k {S}Foot=o
""",
    "Axis Neuron": """
Robot_Hips=h Robot_Spine=s Robot_Spine1=s Robot_Spine2=s Robot_Spine3=s Robot_Neck=n Robot_Head=H
Robot_Spine3: Robot_{S}Shoulder=c Robot_{S}Arm=a Robot_{S}ForeArm=f Robot_{S}Hand=w Robot_{S}HandThumb1
Robot_Hips: Robot_{S}UpLeg=t Robot_{S}Leg=k Robot_{S}Foot=o
""",
    "Qualisys": """
Reference Hips=h Spine=s Spine1=s Spine2=s Neck=n Head=H Head_end
Spine2: {S}Shoulder=c {S}Arm=a {S}ForeArm=f {S}ForeArmRoll {S}Hand=w {S}Hand_end
{S}Hand: {S}InHandThumb {S}HandThumb0 {S}HandThumb1
Hips: {S}UpLeg=t {S}Leg=k {S}Foot=o {S}ToeBase=e {S}ToeBase_end
""",
    "Vicon Shogun": """
Hips=h Spine=s Spine1=s Spine2=s Spine3=s Neck=n Neck1=n Head=H HeadEnd
Spine3: {S}Shoulder=c {S}Arm=a {S}ForeArm=f {S}Hand=w {S}HandMiddle1 {S}HandMiddle2
Hips: {S}UpLeg=t {S}Leg=k {S}Foot=o {S}ToeBase=e {S}ToeBaseEnd
""",
    "Sony mocopi": """
root=h torso_1=s torso_2=s torso_3=s torso_4=s torso_5=s torso_6=s torso_7=s neck_1=n neck_2=n head=H head_End
torso_7: {l}_shoulder=c {l}_up_arm=a {l}_low_arm=f {l}_hand=w {l}_hand_End
root: {l}_up_leg=t {l}_low_leg=k {l}_foot=o {l}_toes=e {l}_toes_End
""",
    "Second Life": """
mPelvis=h mTorso=s mChest=s mNeck=n mHead=H mSkull
mHead: mEye{S}
mHead: mFaceRoot mFaceJaw
mChest: mCollar{S}=c mShoulder{S}=a mElbow{S}=f mWrist{S}=w mHandIndex1{S}
mPelvis: mHip{S}=t mKnee{S}=k mAnkle{S}=o mFoot{S}=e mToe{S}
mPelvis: mHindLimbsRoot mHindLimb1{S}
mChest: mWingsRoot mWing1{S}
""",
    "bvhacker": """
hip=h abdomen=s chest=s neck=n head=H figureHair
chest: {l}Collar=c {l}Shldr=a {l}ForeArm=f {l}Hand=w
hip: {l}Thigh=t {l}Shin=k {l}Foot=o
""",
    "MakeHuman, default": """
root=h spine05=s spine04=s spine03=s spine02=s spine01=s neck01=n neck02=n neck03=n head=H jaw tongue00
root: pelvis.{L} upperleg01.{L}=t upperleg02.{L} lowerleg01.{L}=k lowerleg02.{L} foot.{L}=o toe1-1.{L} toe1-2.{L}
foot.{L}: toe2-1.{L}
foot.{L}: toe3-1.{L}
spine01: clavicle.{L}=c shoulder01.{L} upperarm01.{L}=a upperarm02.{L} lowerarm01.{L}=f lowerarm02.{L} wrist.{L}=w finger1-1.{L}
wrist.{L}: metacarpal1.{L} finger2-1.{L}
spine02: breast.{L}
""",
    "MakeHuman, game_engine": """
Root pelvis=h spine_01=s spine_02=s spine_03=s neck_01=n head=H
spine_03: clavicle_{l}=c upperarm_{l}=a lowerarm_{l}=f hand_{l}=w thumb_01_{l}
pelvis: thigh_{l}=t calf_{l}=k foot_{l}=o ball_{l}=e
""",
    "MB-Lab": """
root pelvis=h spine01=s spine02=s spine03=s neck=n head=H
spine03: clavicle_{L}=c upperarm_{L}=a upperarm_twist_{L}
upperarm_{L}: lowerarm_{L}=f lowerarm_twist_{L}
lowerarm_{L}: hand_{L}=w index00_{L} index01_{L}
pelvis: thigh_{L}=t calf_{L}=k foot_{L}=o toes_{L}=e
spine03: breast_{L}
""",
    "Human3.6M, .bvh": """
Hips=h Spine=s Spine1=s Neck=n Head=H
Spine1: {S}Shoulder=c {S}Arm=a {S}ForeArm=f {S}Hand=w {S}HandThumb
Hips: {S}UpLeg=t {S}Leg=k {S}Foot=o {S}ToeBase=e
""",
    "Human3.6M, points": """
Hip=h Spine=s Thorax=s Neck=n Head=H
Thorax: {L}Shoulder=a {L}Elbow=f {L}Wrist=w
Hip: {L}Hip=t {L}Knee=k {L}Foot=o
""",
    "Unity humanoid": """
Hips=h Spine=s Chest=s UpperChest=s Neck=n Head=H
UpperChest: {S}Shoulder=c {S}UpperArm=a {S}LowerArm=f {S}Hand=w
{S}Hand: Index~Proximal.{L} Index~Intermediate.{L}
Hips: {S}UpperLeg=t {S}LowerLeg=k {S}Foot=o {S}Toes=e
""",
    "VRChat": """
Hips=h Spine=s Chest=s Neck=n Head=H
Chest: {S}~shoulder=c {S}~arm=a {S}~elbow=f {S}~wrist=w
Hips: {S}~leg=t {S}~knee=k {S}~ankle=o {S}~toe=e
""",
    "Source engine": """
ValveBiped.Bip01_Pelvis=h ValveBiped.Bip01_Spine=s ValveBiped.Bip01_Spine1=s ValveBiped.Bip01_Spine2=s ValveBiped.Bip01_Spine4=s
ValveBiped.Bip01_Spine4: ValveBiped.Bip01_Neck1=n ValveBiped.Bip01_Head1=H ValveBiped.forward
ValveBiped.Bip01_Spine4: ValveBiped.Bip01_{L}_Clavicle=c ValveBiped.Bip01_{L}_UpperArm=a ValveBiped.Bip01_{L}_Elbow
ValveBiped.Bip01_{L}_UpperArm: ValveBiped.Bip01_{L}_Shoulder
ValveBiped.Bip01_{L}_UpperArm: ValveBiped.Bip01_{L}_Forearm=f ValveBiped.Bip01_{L}_Wrist
ValveBiped.Bip01_{L}_Forearm: ValveBiped.Bip01_{L}_Hand=w ValveBiped.Bip01_{L}_Finger0
ValveBiped.Bip01_Pelvis: ValveBiped.Bip01_{L}_Thigh=t ValveBiped.Bip01_{L}_Calf=k ValveBiped.Bip01_{L}_Foot=o
ValveBiped.Bip01_{L}_Foot: ValveBiped.Bip01_{L}_Toe0=e
""",
    "Source 2": """
pelvis=h spine_0=s spine_1=s spine_2=s spine_3=s neck_0=n head=H
spine_3: clavicle_{L}=c arm_upper_{L}=a arm_lower_{L}=f hand_{L}=w finger_index_0_{L}
arm_upper_{L}: arm_upper_{L}_TWIST
pelvis: leg_upper_{L}=t leg_lower_{L}=k ankle_{L}=o ball_{L}=e
""",
    "Roblox R15": """
HumanoidRootPart LowerTorso=h UpperTorso=s Head=H
UpperTorso: {S}UpperArm=a {S}LowerArm=f {S}Hand=w
LowerTorso: {S}UpperLeg=t {S}LowerLeg=k {S}Foot=o
""",
    "Cascadeur": """
pelvis=h stomach=s chest=s neck=n head=H
chest: clavicle_{l}=c arm_{l}=a forearm_{l}=f hand_{l}=w
pelvis: thigh_{l}=t calf_{l}=k foot_{l}=o toe_{l}=e
""",
    "DeepMotion": """
Root hips_JNT=h spine_JNT=s spine1_JNT=s spine2_JNT=s neck_JNT=n head_JNT=H
spine2_JNT: {l}_shoulder_JNT=c {l}_arm_JNT=a {l}_forearm_JNT=f {l}_hand_JNT=w {l}_handIndex1_JNT
hips_JNT: {l}_upleg_JNT=t {l}_leg_JNT=k {l}_foot_JNT=o {l}_toebase_JNT=e
""",
    "Plask": _changed(HUMAN_IK, lambda p: p.replace("{S}", "{s}").replace("Hips", "hips").replace("Spine", "spine")),
    "Move.ai": """
Root Hips=h Spine=s Spine1=s Neck=n Head=H Head_end
Spine1: {S}Shoulder=c {S}Arm=a {S}ForeArm=f {S}Hand=w palm_01_{L} {S}HandIndex1
Hips: {S}UpLeg=t {S}Leg=k {S}Foot=o {S}ToeBase=e
{S}Foot: heel_02_{L}
""",
    "Skyrim": """
NPC~Root~[Root] NPC~COM~[COM]=h NPC~Spine~[Spn0]=s NPC~Spine1~[Spn1]=s NPC~Spine2~[Spn2]=s NPC~Neck~[Neck]=n NPC~Head~[Head]=H
NPC~COM~[COM]: NPC~Pelvis~[Pelv] NPC~{L}~Thigh~[{L}Thg]=t NPC~{L}~Calf~[{L}Clf]=k NPC~{L}~Foot~[{L}ft~]=o
NPC~{L}~Foot~[{L}ft~]: NPC~{L}~Toe0~[{L}Toe]=e
NPC~Spine2~[Spn2]: NPC~{L}~Clavicle~[{L}Clv]=c NPC~{L}~UpperArm~[{L}Uar]=a NPC~{L}~Forearm~[{L}Lar]=f NPC~{L}~Hand~[{L}Hnd]=w
NPC~{L}~UpperArm~[{L}Uar]: NPC~{L}~UpperarmTwist1~[{L}Ut1]
""",
    "Koikatsu": """
cf_j_root cf_n_height cf_j_hips=h cf_j_spine01=s cf_j_spine02=s cf_j_spine03=s cf_j_neck=n cf_j_head=H
cf_j_spine03: cf_d_shoulder_{L} cf_j_shoulder_{L}=c cf_j_arm00_{L}=a cf_j_forearm01_{L}=f cf_j_hand_{L}=w cf_j_index01_{L}
cf_j_hips: cf_j_waist01 cf_j_waist02 cf_j_thigh00_{L}=t cf_j_leg01_{L}=k cf_j_foot_{L}=o cf_j_toes_{L}=e
""",
    "Chinese": """
髋=h 脊柱1=s 脊柱2=s 胸=s 颈=n 头=H
胸: {J}锁骨=c {J}上臂=a {J}前臂=f {J}手=w
髋: {J}大腿=t {J}小腿=k {J}脚=o {J}脚趾=e
""",
    "H-Anim": """
hanim_humanoid_root=h hanim_vl5=s hanim_vl3=s hanim_vt10=s hanim_vt1=s hanim_vc4=n hanim_skullbase=H
hanim_vt1: hanim_{l}_sternoclavicular=c hanim_{l}_acromioclavicular hanim_{l}_shoulder=a hanim_{l}_elbow=f
hanim_{l}_elbow: hanim_{l}_radiocarpal=w
hanim_humanoid_root: hanim_sacroiliac hanim_{l}_hip=t hanim_{l}_knee=k hanim_{l}_talocrural=o hanim_{l}_metatarsophalangeal_2
""",
}


def skeleton(text: str) -> tuple[tuple[str, ...], list[int], dict[str, list[int]]]:
    """Return names, parents, and the joints of each role, in order."""
    names: list[str] = []
    parents: list[int] = []
    roles: dict[str, list[int]] = {}
    for line in text.strip().splitlines():
        for side in SIDES if "{" in line else ("",):
            above = -1
            for k, part in enumerate(line.split()):
                label, _, letter = part.partition("=")
                name = label.replace("~", " ").format(**SIDES.get(side, {}))
                if k == 0 and name.removesuffix(":") in names:
                    above = names.index(name.removesuffix(":"))
                    continue
                if name not in names:  # the middle of a line of both sides
                    names.append(name)
                    parents.append(above)
                    if letter:
                        roles.setdefault(f"{side if '{' in label else ''} {ROLES[letter]}".strip(), []).append(len(names) - 1)
                above = names.index(name)
    return tuple(names), parents, roles
