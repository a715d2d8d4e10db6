"""Cards and parameters without effect on real normal modes: loads, damping, design, output."""

from __future__ import annotations

from modetune.adapters.nastran.fields import read_number

#: Whole parts of a model that jobs on another solver than Nastran do without.
LEFT_OUT = frozenset(
    # aeroelasticity
    "AERO AEROS CAERO1 CAERO2 CAERO3 CAERO4 CAERO5 CAERO7 PAERO1 PAERO2 PAERO3 PAERO4 PAERO5 "
    "PAERO7 SPLINE1 SPLINE2 SPLINE3 SPLINE4 SPLINE5 SPLINE6 SPLINE7 AEFACT AELINK AELIST AEPARM "
    "AESTAT AESURF AESURFS AECOMP AECOMPL AEFORCE AEPRESS AEDW AEGRID AEQUAD4 AETRIA3 AESCALE "
    "CSSCHD DIVERG FLFACT FLUTTER FLUTPRM GUST GUST2 MKAERO1 MKAERO2 MKAEROZ TRIM TRIM2 UXVEC "
    "AEROZ BODY7 PANLST1 PANLST2 PANLST3 ACOORD AESURFZ FOILSEC SEGMESH TRIMVAR TRIMLNK "
    # points of control systems, of which real modes know nothing
    "EPOINT TF NOLIN1 NOLIN2 NOLIN3 NOLIN4 NLRGAP NLRSFD "
    # rotors, whose gyroscopic terms real modes do not have
    "ROTORD ROTORG RSPINR RSPINT UNBALNC "
    # acoustics
    "ACMODL ACCSSPT "
    "AMLREG BSURFS BSURF BEDGE ACADAPT ACORDER ACPLNW ACSRCE PMIC MICPNT VATVFS RCROSS PANEL "
    # sets of a reduction, which a job on another solver does without
    "ASET ASET1 QSET QSET1 BSET BSET1 CSET CSET1 OMIT OMIT1 BNDFIX BNDFIX1 BNDFREE BNDFREE1 "
    "RVDOF RVDOF1 RANDVAR NLSTEP NLPCI NLCNTL NLCNTL2 NLCNTLG TSTEP1 TEMPP3 TEMPF "
    # how materials and springs change with temperature, strain or frequency
    "MATT1 MATT2 MATT3 MATT8 MATT9 MATT10 MATT11 MATTC MATS1 MATS3 MATS8 MATDMG PBUSHT PELAST "
    "PDAMPT PFASTT CREEP TABLEM5 TABLED5 "
    # contact and bolts of nonlinear solutions, heat, drawing, p-elements' output
    "BCPARA BCTPARM BCRPARA BOLT BOLTFOR BOLTLD TEMPBC QVOL QBDY1 QBDY2 QBDY3 QHBDY RTRPLT VIEW "
    "OUTPUT OUTRCV PVAL PLOADX CLOAD ABSNMVS ABSTRCT TOPVAR DVTREL1 DMNCON DMRLAW "
    "PLOTE PLOTG PLOTOPT NORMAL".split()
)
#: Without effect on normal modes.
HARMLESS = LEFT_OUT | frozenset(
    # beginnings and ends, methods, control
    "ENDDATA BEGIN EIGRL EIGR EIGB EIGC EIGP ECHOON ECHOOFF INCLUDE "
    # defaults that are filled in, results along bars, groups
    "GRDSET BAROR BEAMOR CBARAO GROUP "
    # loads, temperatures and their tables
    "LOAD FORCE FORCE1 FORCE2 MOMENT MOMENT1 MOMENT2 PLOAD PLOAD1 PLOAD2 PLOAD4 PLOADX1 GRAV "
    "ACCEL ACCEL1 RFORCE SLOAD SPCD TEMP TEMPD TEMPP1 TEMPRB LSEQ LOADCYN DEFORM "
    "DLOAD DAREA DPHASE DELAY RLOAD1 RLOAD2 TLOAD1 TLOAD2 RANDPS RANDT1 TIC "
    "FREQ FREQ1 FREQ2 FREQ3 FREQ4 FREQ5 TSTEP TSTEPNL NLPARM "
    "TABLED1 TABLED2 TABLED3 TABLED4 TABLEM1 TABLEM2 TABLEM3 TABLEM4 TABLES1 TABLEST "
    "TABRND1 TABRNDG TABDMP1 DTI "
    # damping
    "CDAMP1 CDAMP2 CDAMP3 CDAMP4 CDAMP5 PDAMP PDAMP5 PDAMPT CVISC PVISC "
    # support of rigid bodies, which static solutions need
    "SUPORT SUPORT1 "
    # heat, and sets that only a matrix language program reads
    "MAT4 MAT5 MATT4 MATT5 USET USET1 "
    # drawing, sets and monitoring
    "PLOTEL PLOTEL3 PLOTEL4 PLOTEL6 PLOTEL8 SET1 SET2 SET3 MONPNT1 MONPNT2 MONPNT3 MONDSP1 "
    "POINT GMCURV GMSURF CSSCHD "
    # design
    "DESVAR DVPREL1 DVPREL2 DVMREL1 DVMREL2 DVCREL1 DVCREL2 DRESP1 DRESP2 DRESP3 DCONSTR DCONADD "
    "DEQATN DVGRID DVBSHAP DVSHAP DOPTPRM DSCREEN DLINK DDVAL DTABLE".split()
)
#: Materials' dependence on temperature, which counts where the case control selects one.
TEMPERATURE_DEPENDENT = ("MATT1", "MATT2", "MATT3", "MATT8", "MATT9", "MATT11")
#: Parameters that change normal modes and that no job but Nastran's own follows, with the value
#: that leaves the modes alone: factors on stiffness and on added matrices.
CHANGING = {
    "CK1": 1.0, "CK2": 1.0, "CK3": 1.0, "CK41": 1.0, "CM1": 1.0, "CM2": 1.0, "INRLM": 0.0,
    "BUCKLE": 0.0, "VMOPT": 0.0, "SEP1XOVR": 0.0,
}  # fmt: skip
#: Those that every solver here follows, or has another way for (loose freedoms are held).
FOLLOWED_PARAMETERS = frozenset(
    ("WTMASS", "COUPMASS", "AUTOSPC", "AUTOSPCR", "K6ROT", "SNORM", "MAXRATIO", "EPZERO", "BAILOUT")
)
#: What an MDLPRM card may hold: formats of output, and how offsets turn where they are large.
MODEL_PARAMETERS = frozenset(("HDF5", "H5MDL", "H5NORDOF", "H5GM34", "MRALIAS", "H5INFO"))
OFFSETS = ("LROFF", "ELMOFF", "NODIF", "NOTHRM")


def changing_parameter(name: str, value: str) -> str:
    """Why a parameter cannot be left out, empty if it can."""
    try:
        changes = name in CHANGING and read_number(value or "0") != CHANGING[name]
    except ValueError:
        changes = True
    return f"PARAM,{name},{value} changes normal modes and is not translated" if changes else ""


def changing_model_parameter(name: str, value: str) -> str:
    """Why a parameter of an MDLPRM card cannot be left out, empty if it can."""
    if name in MODEL_PARAMETERS or (name == "OFFDEF" and value in OFFSETS):
        return ""
    return f"MDLPRM,{name},{value}: not known to be without effect on normal modes; take it out"
