# Queues the verified flows of system teleop on eth0: sh FILE
# /video /robot/camera → /viewer: udp 10.9.0.1:17900 → 10.9.0.2:17910: EF = DSCP 46 = TOS 184 (0xb8), 5QI 85, at most 5 ms
# /depth /robot/camera → /viewer: udp 10.9.0.1:17901 → 10.9.0.2:17911: EF = DSCP 46 = TOS 184 (0xb8)
# /bulk /robot/camera → /viewer: udp *:17900 → 10.9.0.2:17912: LE = DSCP 1 = TOS 4 (0x04)
# /log /robot/camera → /viewer: tcp 10.9.0.1:17903 → 10.9.0.2:17913: DSCP 5 = TOS 20 (0x14)
# /lidar /robot/camera → /viewer: udp [fd09::1]:17904 → [fd09::2]:17914: NQB = DSCP 45 = TOS 180 (0xb4), flow label 0x12345
# /touch /robot/camera → /viewer: udp 10.9.0.1:17905 → 10.9.0.2:17915: 5QI 9
# left out: /map /robot/camera → /viewer: not verified: its verdict is unverifiable
set -e
tc -batch - <<'END'
qdisc add dev eth0 root handle 1f10: htb default 0xfff
class replace dev eth0 parent 1f10: classid 1f10:1 htb rate 20000kbit ceil 20000kbit quantum 3028
# class 1f10:12e: EF = DSCP 46 = TOS 184 (0xb8)
class replace dev eth0 parent 1f10:1 classid 1f10:12e htb rate 4000kbit ceil 20000kbit prio 0 quantum 3028
qdisc replace dev eth0 parent 1f10:12e handle 212e: bfifo limit 125000
# class 1f10:12d: NQB = DSCP 45 = TOS 180 (0xb4)
class replace dev eth0 parent 1f10:1 classid 1f10:12d htb rate 3950kbit ceil 20000kbit prio 1 quantum 3028
qdisc replace dev eth0 parent 1f10:12d handle 212d: bfifo limit 125000
# class 1f10:105: DSCP 5 = TOS 20 (0x14)
class replace dev eth0 parent 1f10:1 classid 1f10:105 htb rate 3950kbit ceil 20000kbit prio 2 quantum 3028
qdisc replace dev eth0 parent 1f10:105 handle 2105: bfifo limit 125000
# class 1f10:209: 5QI 9 (Non-GBR)
class replace dev eth0 parent 1f10:1 classid 1f10:209 htb rate 3950kbit ceil 20000kbit prio 3 quantum 3028
qdisc replace dev eth0 parent 1f10:209 handle 2209: bfifo limit 125000
# class 1f10:fff: everything else
class replace dev eth0 parent 1f10:1 classid 1f10:fff htb rate 3950kbit ceil 20000kbit prio 6 quantum 3028
qdisc replace dev eth0 parent 1f10:fff handle 2fff: bfifo limit 125000
# class 1f10:101: LE = DSCP 1 = TOS 4 (0x04)
class replace dev eth0 parent 1f10:1 classid 1f10:101 htb rate 200kbit ceil 20000kbit prio 7 quantum 3028
qdisc replace dev eth0 parent 1f10:101 handle 2101: bfifo limit 125000
END
nft -f - <<'END'
add table inet flowtc_eth0_teleop
delete table inet flowtc_eth0_teleop
table inet flowtc_eth0_teleop {
  comment "managed-by=lifecycle"
  chain post {
    type filter hook postrouting priority -149; policy accept;
    oifname "eth0" ip saddr 10.9.0.1 udp sport 17900 ip daddr 10.9.0.2 udp dport 17910 meta priority set 1f10:12e counter comment "EF = DSCP 46 = TOS 184 (0xb8): /video /robot/camera → /viewer"
    oifname "eth0" ip saddr 10.9.0.1 udp sport 17901 ip daddr 10.9.0.2 udp dport 17911 meta priority set 1f10:12e counter comment "EF = DSCP 46 = TOS 184 (0xb8): /depth /robot/camera → /viewer"
    oifname "eth0" udp sport 17900 ip daddr 10.9.0.2 udp dport 17912 meta priority set 1f10:101 counter comment "LE = DSCP 1 = TOS 4 (0x04): /bulk /robot/camera → /viewer"
    oifname "eth0" ip saddr 10.9.0.1 tcp sport 17903 ip daddr 10.9.0.2 tcp dport 17913 meta priority set 1f10:105 counter comment "DSCP 5 = TOS 20 (0x14): /log /robot/camera → /viewer"
    oifname "eth0" ip6 saddr fd09::1 udp sport 17904 ip6 daddr fd09::2 udp dport 17914 meta priority set 1f10:12d counter comment "NQB = DSCP 45 = TOS 180 (0xb4): /lidar /robot/camera → /viewer"
    oifname "eth0" ip saddr 10.9.0.1 udp sport 17905 ip daddr 10.9.0.2 udp dport 17915 meta priority set 1f10:209 counter comment "5QI 9 (Non-GBR): /touch /robot/camera → /viewer"
  }
}
END
